// The project as a graph that lives: colours are what nodes do now, labels what connections carry.

import {milliseconds, percent, rate} from "./format.js";
import {colour, onTheme} from "./theme.js";

const COLOURS = {
  executing: "#2e9e5b", scheduling: "#2e9e5b", waiting: "#4a90d9", blocked: "#d9534f",
  idle: "#8793a0", registering: "#8793a0", loading: "#8793a0", paused: "#b58bd6",
  ended: "#5b6773", unknown: "#5b6773",
};
const NARROW_PX = 560; // of a box in which the graph goes downwards
const READABLE_PX = 13;
const [LEAST_HEIGHT, MOST_HEIGHT, MARGIN] = [150, 560, 20];

function style() {
  const [ink, paper, link] = ["--ink", "--paper", "--link"].map(colour);
  return [
    {selector: "node", style: {
      shape: "round-rectangle", width: 180, height: 64, "background-color": "data(colour)",
      label: "data(label)", "text-valign": "center", "text-halign": "center", "text-wrap": "wrap",
      "text-max-width": 176, color: "#fff", "font-size": 15,
      "font-family": "system-ui, sans-serif",
    }},
    {selector: "node.topic, node.elsewhere", style: {
      "background-color": paper, "border-width": 1, "border-color": "#7b8794", color: ink,
    }},
    {selector: "node.topic", style: {shape: "ellipse"}},
    {selector: "edge", style: {
      "curve-style": "bezier", "target-arrow-shape": "triangle", width: 2, label: "data(label)",
      "line-color": "#7b8794", "target-arrow-color": "#7b8794", "text-wrap": "wrap",
      "text-background-color": paper, "text-background-opacity": 0.9,
      "text-background-padding": 2, color: ink, "font-family": "system-ui, sans-serif",
      "control-point-step-size": 110,
    }},
    {selector: "edge.lossless", style: {width: 4}},
    {selector: "edge.best-effort", style: {"line-style": "dashed"}},
    {selector: "edge[?blocked]", style: {"line-color": "#d9534f", "target-arrow-color": "#d9534f"}},
    {selector: ":selected", style: {"border-width": 3, "border-color": ink,
      "line-color": link, "target-arrow-color": link}},
  ];
}

export class Graph {
  constructor(box, plan, onSelect) {
    [this.plan, this.box] = [plan, box];
    this.cy = cytoscape({container: box, elements: elementsOf(plan), maxZoom: 2});
    onTheme(() => {
      this.cy.style(style());
      this.writeLabels();
    });
    this.cy.on("position", "node", (event) => {
      placeLabels(this.cy, event.target.connectedEdges());
    });
    this.cy.on("tap", "node, edge", (event) => {
      const {kind, name} = event.target.data();
      if (kind) onSelect(kind, name);
    });
    new ResizeObserver(() => this.fit()).observe(box);
  }

  // From left to right, or downwards where there is no room for that; as high as it needs to be.
  arrange(isNarrow) {
    if (this.isNarrow === isNarrow) return;
    this.isNarrow = isNarrow;
    if (this.figures) this.show(this.figures);
    this.cy.layout({name: "dagre", rankDir: isNarrow ? "TB" : "LR", nodeSep: 110,
      rankSep: isNarrow ? 110 : 220, edgeSep: 110, fit: false}).run();
    placeLabels(this.cy, this.cy.edges());
  }

  fit() {
    const width = this.box.clientWidth;
    if (!width) return;
    this.arrange(width < NARROW_PX);
    const {w, h} = this.cy.elements().boundingBox();
    const height = 2 * MARGIN + h * Math.min(1, (width - 2 * MARGIN) / w);
    this.box.style.setProperty("--natural",
      `${Math.round(Math.max(LEAST_HEIGHT, Math.min(MOST_HEIGHT, height)))}px`);
    this.cy.resize();
    this.cy.fit(undefined, MARGIN);
    this.writeLabels();
    this.cy.fit(undefined, MARGIN);
  }

  // Beside the edges; as large as can be read, if the graph is drawn smaller than it is.
  writeLabels() {
    const size = READABLE_PX / this.cy.zoom();
    this.cy.edges().style({
      "font-size": Math.max(READABLE_PX, Math.min(this.isNarrow ? 24 : 16, size)),
      "text-rotation": this.isNarrow ? "none" : "autorotate",
      "text-margin-x": (edge) => edge.data("x") * (this.isNarrow ? aside(edge) : away(edge)),
      "text-margin-y": (edge) => this.isNarrow ? 0 : edge.data("y") * away(edge),
    });
  }

  show(figures) {
    this.figures = figures;
    this.cy.batch(() => {
      for (const [name, node] of Object.entries(figures.nodes)) {
        this.cy.getElementById(`node ${name}`).data({
          colour: COLOURS[node.executing ? "executing" : node.state] ?? COLOURS.idle,
          state: node.executing ? "executing" : node.state,
          label: `${name}\n${doing(node)}`
            + (node.shares ? `\nexecuting ${percent(node.shares.executing)}` : ""),
        });
      }
      for (const [name, c] of Object.entries(figures.connections)) {
        const edge = this.cy.getElementById(`connection ${name}`);
        if (edge.empty()) continue;
        const window = edge.data("window");
        const parts = [`${rate(c.rate_hz)}/s`];
        if (c.latency_ms !== null && c.latency_ms !== undefined) parts.push(milliseconds(c.latency_ms));
        if (!this.isNarrow && edge.data("isReliable") && c.outstanding !== undefined) {
          parts.push(`${c.outstanding} of ${window} out`);
        }
        const missed = [];
        if (c.discarded) missed.push(`${c.discarded} discarded`);
        if (c.lost) missed.push(`${c.lost} lost`);
        edge.data({blocked: Boolean(c.is_blocked),
          label: [edge.data(this.isNarrow ? "ports" : "title"), parts.join(this.isNarrow ? "\n" : ", "), missed.join(", ")].join("\n").trimEnd()});
      }
    });
  }
}

// Labels lie beside their edges: of edges between the same nodes on the left of who goes along (an
// edge that comes back bends the other way, and has its label there), else on the outer side.
function placeLabels(cy, edges) {
  const {x1, x2, y1, y2} = cy.nodes().boundingBox({includeLabels: false});
  for (const edge of edges) {
    const [from, to] = [edge.source().position(), edge.target().position()];
    const [dx, dy] = [to.x - from.x || 1, to.y - from.y];
    const fromCentre = {x: (from.x + to.x - x1 - x2) / 2, y: (from.y + to.y - y1 - y2) / 2};
    const isInside = edge.parallelEdges().length === 1 && dy * fromCentre.x - dx * fromCentre.y < 0;
    const side = (isInside ? -1 : 1) / Math.hypot(dx, dy);
    edge.data({x: side * dy, y: -side * dx});
  }
}

function away(edge) {
  return 10 + 8.5 * edge.data("label").split("\n").length;
}

// Half of the text beside a single edge; those between the same nodes are far enough apart.
function aside(edge) {
  if (edge.parallelEdges().length > 1) return 0;
  const most = Math.max(...edge.data("label").split("\n").map((line) => line.length));
  return 8 + 0.28 * most * parseFloat(edge.style("font-size"));
}

function doing(node) {
  if (node.executing) return `executes ${node.executing}`;
  if (node.state === "waiting") return `waits for ${node.cause}`;
  if (node.state === "blocked") return `blocked by ${node.cause.split(" -> ")[1]?.split(".")[0]}`;
  return node.state;
}

function elementsOf(plan) {
  const elements = plan.nodes.map((node) => ({
    data: {id: `node ${node.name}`, kind: "node", name: node.name, label: node.name,
      colour: COLOURS.loading},
    classes: node.is_here ? "" : "elsewhere",
  }));
  for (const c of plan.connections) {
    const ports = c.output === c.input ? c.output : `${c.output} → ${c.input}`;
    const title = `${ports}: ${c.guarantee}`;
    elements.push({
      data: {id: `connection ${c.name}`, kind: "connection", name: c.name, ports, title, label: title,
        source: `node ${c.from}`, target: `node ${c.to}`, window: c.window,
        isReliable: c.discard_limit !== null, x: 0, y: 0},
      classes: c.discard_limit === 0 ? "lossless" : c.discard_limit === null ? "best-effort" : "",
    });
  }
  for (const topic of new Set(plan.topics.map((each) => each.full))) {
    elements.push({data: {id: `topic ${topic}`, label: topic}, classes: "topic"});
  }
  for (const each of plan.topics) {
    const ends = [`topic ${each.full}`, `node ${each.node}`];
    if (!each.is_in) ends.reverse();
    elements.push({
      data: {id: `connection ${each.name}`, kind: "topic", name: each.name, ports: "", title: "", label: "",
        source: ends[0], target: ends[1], x: 0, y: 0},
      classes: "best-effort",
    });
  }
  return elements;
}
