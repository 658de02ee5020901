// The project as a graph that lives: colours are what nodes do now, labels what connections carry.

import {milliseconds, percent, rate} from "./format.js";

const COLOURS = {
  executing: "#2e9e5b", scheduling: "#2e9e5b", waiting: "#4a90d9", blocked: "#d9534f",
  idle: "#9aa5b1", registering: "#c9d0d8", loading: "#c9d0d8", paused: "#b58bd6",
  elsewhere: "#ffffff", ended: "#5b6773", unknown: "#5b6773",
};
const STYLE = [
  {selector: "node", style: {
    shape: "round-rectangle", width: 180, height: 64, "background-color": "data(colour)",
    label: "data(label)", "text-valign": "center", "text-halign": "center", "text-wrap": "wrap",
    "text-max-width": 176, color: "#fff", "font-size": 14, "font-family": "system-ui, sans-serif",
  }},
  {selector: "node.topic, node.elsewhere", style: {
    "background-color": "#fff", "border-width": 1, "border-color": "#7b8794", color: "#1d2733",
  }},
  {selector: "node.topic", style: {shape: "ellipse"}},
  {selector: "edge", style: {
    "curve-style": "bezier", "target-arrow-shape": "triangle", width: 2, label: "data(label)",
    "line-color": "#7b8794", "target-arrow-color": "#7b8794", "font-size": 12,
    "text-wrap": "wrap", "text-background-color": "#fff", "text-background-opacity": 0.9,
    "text-background-padding": 2, color: "#1d2733", "font-family": "system-ui, sans-serif",
    "control-point-step-size": 110, "text-rotation": "autorotate",
    "text-margin-x": (edge) => edge.data("x") * away(edge),
    "text-margin-y": (edge) => edge.data("y") * away(edge),
  }},
  {selector: "edge.lossless", style: {width: 4}},
  {selector: "edge.best-effort", style: {"line-style": "dashed"}},
  {selector: "edge[?blocked]", style: {"line-color": "#d9534f", "target-arrow-color": "#d9534f"}},
  {selector: ":selected", style: {"border-width": 3, "border-color": "#1d2733",
    "line-color": "#1a66c2", "target-arrow-color": "#1a66c2"}},
];

export class Graph {
  constructor(box, plan, onSelect) {
    this.plan = plan;
    this.cy = cytoscape({container: box, elements: elementsOf(plan), style: STYLE,
      maxZoom: 2});
    this.cy.layout({name: "dagre", rankDir: "LR", nodeSep: 110, rankSep: 200, edgeSep: 110,
      fit: true, padding: 20}).run();
    placeLabels(this.cy, this.cy.edges());
    this.cy.on("position", "node", (event) => {
      placeLabels(this.cy, event.target.connectedEdges());
    });
    this.cy.on("tap", "node, edge", (event) => {
      const {kind, name} = event.target.data();
      if (kind) onSelect(kind, name);
    });
    new ResizeObserver(() => { this.cy.resize(); this.cy.fit(undefined, 20); }).observe(box);
  }

  show(figures) {
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
        if (edge.data("isReliable") && c.outstanding !== undefined) {
          parts.push(`${c.outstanding} of ${window} out`);
        }
        const missed = [];
        if (c.discarded) missed.push(`${c.discarded} discarded`);
        if (c.lost) missed.push(`${c.lost} lost`);
        edge.data({blocked: Boolean(c.is_blocked),
          label: [edge.data("title"), parts.join(", "), missed.join(", ")].join("\n").trimEnd()});
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
  return 10 + 7.5 * edge.data("label").split("\n").length;
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
      colour: COLOURS[node.is_here ? "loading" : "elsewhere"]},
    classes: node.is_here ? "" : "elsewhere",
  }));
  for (const c of plan.connections) {
    const ports = c.output === c.input ? c.output : `${c.output} → ${c.input}`;
    const title = `${ports}: ${c.guarantee}`;
    elements.push({
      data: {id: `connection ${c.name}`, kind: "connection", name: c.name, title, label: title,
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
      data: {id: `connection ${each.name}`, kind: "topic", name: each.name, title: "", label: "",
        source: ends[0], target: ends[1], x: 0, y: 0},
      classes: "best-effort",
    });
  }
  return elements;
}
