// The project as a graph that lives: colours are what nodes do now, labels what connections carry.

import {milliseconds, percent, rate} from "./format.js";

const COLOURS = {
  executing: "#2e9e5b", scheduling: "#2e9e5b", waiting: "#4a90d9", blocked: "#d9534f",
  idle: "#9aa5b1", registering: "#c9d0d8", loading: "#c9d0d8", paused: "#b58bd6",
  elsewhere: "#ffffff",
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
    "control-point-step-size": 90,
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
    this.cy.layout({name: "dagre", rankDir: "LR", nodeSep: 110, rankSep: 170, edgeSep: 110,
      fit: true, padding: 20}).run();
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
            + (node.shares ? `\nbusy ${percent(node.shares.executing)}` : ""),
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
        if (c.discarded) parts.push(`${c.discarded} discarded`);
        edge.data({blocked: Boolean(c.is_blocked),
          label: `${edge.data("title")}\n${parts.join(", ")}`});
      }
    });
  }
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
        isReliable: c.discard_limit !== null},
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
        source: ends[0], target: ends[1]},
      classes: "best-effort",
    });
  }
  return elements;
}
