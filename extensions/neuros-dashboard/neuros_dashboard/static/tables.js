// Connections and nodes as tables: what the graph shows, with all figures.

import {element, milliseconds, number, percent, rate, Row} from "./format.js";

export class Tables {
  constructor(plan, onSelect) {
    const connections = document.querySelector("#connections tbody");
    const nodes = document.querySelector("#nodes tbody");
    connections.replaceChildren();
    nodes.replaceChildren();
    const numbers = Array(7).fill("number");
    const all = [...plan.connections, ...plan.topics.map((t) => ({...t, guarantee: "topic"}))];
    this.connections = new Map(all.map((c) => [c.name,
      {plan: c, row: selectable(new Row(connections, c.name, ["", "", ...numbers]),
        () => onSelect(c.topic ? "topic" : "connection", c.name))}]));
    this.nodes = new Map(plan.nodes.filter((node) => node.is_here).map((node) => [node.name,
      selectable(new Row(nodes, node.name, ["", "", "number", "number", "number"]),
        () => onSelect("node", node.name))]));
    for (const [name, {plan: c, row}] of this.connections) row.show(c.title ?? name, c.guarantee);
    for (const [name, row] of this.nodes) row.show(name, "loading");
  }

  show(figures) {
    for (const [name, {plan, row}] of this.connections) {
      const c = figures.connections[name];
      if (!c) continue;
      // A sender elsewhere does not say, and one of best effort does not count.
      const out = plan.discard_limit === null || c.outstanding === undefined
        ? "–" : `${c.outstanding} of ${plan.window}`;
      row.show(plan.title ?? name, plan.guarantee, number(c.sent ?? c.received), rate(c.rate_hz),
        milliseconds(c.latency_ms), out, number(c.unread), number(c.discarded), number(c.lost));
    }
    for (const [name, row] of this.nodes) {
      const node = figures.nodes[name];
      if (!node) continue;
      const shares = node.shares ?? {};
      row.show(name, state(node.state), percent(shares.executing), percent(shares.waiting),
        percent(shares.blocked));
    }
  }

  select(name) {
    for (const row of document.querySelectorAll("tr.selected")) row.classList.remove("selected");
    document.querySelector(`tr[data-name="${CSS.escape(name)}"]`)?.classList.add("selected");
  }
}

export function state(name) {
  return element("span", {class: `state ${name}`}, name);
}

function selectable(row, onClick) {
  row.row.classList.add("selectable");
  row.row.addEventListener("click", onClick);
  return row;
}
