// What was clicked: of a node its hooks, of a connection the fields of its packets.

import {element, milliseconds, number, percent, rate, Row} from "./format.js";
import {LEAST_RING} from "./activity.js";
import {wantAllOf} from "./wants.js";

export class Details {
  constructor(plan, onArray) {
    this.plan = plan;
    this.onArray = onArray;
    this.title = document.querySelector("#details-title");
    this.box = document.querySelector("#details");
    this.source = null;
    this.node = null;
  }

  select(kind, name) {
    this.node = kind === "node" ? name : null;
    this.source = kind === "node" ? null : this.sourceOf(kind, name);
    this.rows = new Map();
    this.body = element("tbody");
    this.title.textContent = this.plan.topics.find((each) => each.name === name)?.title ?? name;
    const type = this.source ? this.source.type : "";
    this.none = element("p", {class: "hint"}, "no packet yet");
    this.box.replaceChildren(element("p", {class: "hint"}, type), element("table", {}, this.body));
    if (this.source) this.box.append(this.none);
    wantAllOf(this.source ? this.source.name : null);
    if (kind !== "node" && !this.source) this.box.append("Its sender is not part of this run.");
  }

  sourceOf(kind, name) {
    const found = this.plan.sources.find((source) => {
      if (kind === "topic") {
        const topic = this.plan.topics.find((each) => each.name === name);
        return source.node === topic.node
          && (topic.is_in ? source.port === topic.topic : name.startsWith(`${source.name} `));
      }
      const connection = this.plan.connections.find((each) => each.name === name);
      return source.node === connection.from && source.port === connection.output;
    });
    return found ?? null;
  }

  showFigures(figures) {
    const node = this.node && figures.nodes[this.node];
    if (!node || !node.hooks) return;
    this.row("doing").show("now", `${node.state} ${node.executing ?? node.cause}`);
    for (const [state, share] of Object.entries(node.shares)) {
      const isNew = !this.rows.has(`share ${state}`);
      if (share > 0.0005 || !isNew) this.row(`share ${state}`).show(state, percent(share));
    }
    for (const [hook, books] of Object.entries(node.hooks)) {
      this.row(`hook ${hook}`).show(hook,
        `${books.executions} times, ${rate(books.rate_hz)}/s, ${milliseconds(books.mean_ms)} each`);
    }
  }

  showSample(name, sample) {
    if (!this.source || name !== this.source.name) return;
    if (sample.fault || sample.all) this.none.remove();
    if (sample.fault) this.row("fault").show("cannot be shown", sample.fault);
    for (const [path, value] of Object.entries(sample.all ?? {})) {
      const isNumber = typeof value !== "string";
      if (!this.rows.has(path)) {
        const {cells: [cell]} = this.row(path);
        cell.append(path);
        // What has an element 0 that is a number is an array of numbers; a few are better read.
        const array = path.endsWith(".length") ? path.slice(0, -".length".length) : null;
        if (array && value >= LEAST_RING && `${array}[0]` in sample.all) {
          cell.append(" ", element("button", {class: "field", title: `draw ${array} as a heat map`,
            onclick: () => this.onArray(name, array)}, "heat map"));
        }
      }
      this.rows.get(path).cells[1].textContent = isNumber ? number(Number(value), 6) : value;
    }
  }

  row(name) {
    if (!this.rows.has(name)) this.rows.set(name, new Row(this.body, name, ["", "number"]));
    return this.rows.get(name);
  }
}
