// Time series of chosen fields: the last minute, one chart per field.

import {element, number} from "./format.js";
import {colour, onTheme} from "./theme.js";
import {want} from "./wants.js";

const KEPT_S = 60;
const HEIGHT = 166;
const AXIS = {stroke: () => colour("--faint"), grid: {stroke: () => colour("--line")}};

export class Series {
  constructor() {
    this.box = document.querySelector("#series");
    this.hint = document.querySelector("#series-hint");
    this.charts = new Map();
    this.isOn = true;
  }

  // Of a layout: the fields to plot.
  choose({fields = []}) {
    const asked = new Set(fields.map(({output, field}) => `${output} ${field}`));
    for (const {source, path} of [...this.charts.values()]) {
      if (!asked.has(`${source} ${path}`)) this.remove(source, path);
    }
    for (const {output, field} of fields) if (!this.has(output, field)) this.add(output, field);
  }

  chosen() {
    const fields = [...this.charts.values()].map(
      ({source, path}) => ({output: source, field: path}));
    return fields.length ? {fields} : {};
  }

  // Whether the page shows this panel.
  enable(isOn) {
    this.isOn = isOn;
    for (const {source, path} of this.charts.values()) this.ask(source, path, isOn);
  }

  ask(source, path, isOn) {
    want(source, (entry) => isOn ? entry.fields.add(path) : entry.fields.delete(path));
  }

  has(source, path) { return this.charts.has(`${source} ${path}`); }

  toggle(source, path) {
    const isNew = !this.has(source, path);
    if (isNew) this.add(source, path);
    else this.remove(source, path);
    this.onChange?.();
    return isNew;
  }

  add(source, path) {
    this.charts.set(`${source} ${path}`,
      new Chart(this.box, source, path, () => this.toggle(source, path)));
    this.ask(source, path, this.isOn);
    this.hint.hidden = true;
  }

  remove(source, path) {
    this.charts.get(`${source} ${path}`).remove();
    this.charts.delete(`${source} ${path}`);
    this.ask(source, path, false);
    this.hint.hidden = this.charts.size > 0;
  }

  show(source, sample) {
    (sample.fields ?? []).forEach((path, place) => {
      this.charts.get(`${source} ${path}`)?.add(sample.values, place + 1);
    });
  }
}

// What hardly changes is a line in the middle, not noise of the last digit.
function rangeOf(_, low, high) {
  if (low === null) return [0, 1];
  const margin = Math.max(0.08 * (high - low), 1e-3 * Math.abs(high), 1e-9);
  return [low - margin, high + margin];
}

// Values between two that are none (NaN), to which no line leads: they are drawn as points.
function lone(plot, place) {
  const values = plot.data[place];
  const [first, last] = plot.series[0].idxs;
  const found = [];
  for (let index = first; index <= last; index += 1) {
    const isNumber = (values[index] ?? null) !== null;
    if (isNumber && (values[index - 1] ?? null) === null && (values[index + 1] ?? null) === null) {
      found.push(index);
    }
  }
  return found;
}

class Chart {
  constructor(box, source, path, onClose) {
    this.source = source;
    this.path = path;
    this.data = [[], []];
    this.last = element("span");
    const close = element("button", {class: "field", title: "remove", onclick: onClose}, "×");
    this.element = element("div", {class: "chart", "data-field": `${source} ${path}`},
      element("h3", {}, `${source} ${path}`, this.last, close));
    box.append(this.element);
    this.plot = new uPlot({
      width: this.element.clientWidth - 12, height: HEIGHT, legend: {show: false},
      scales: {x: {time: false}, y: {range: rangeOf}}, axes: [
        {...AXIS, size: 28, label: "wall clock, s", labelSize: 16, labelFont: "11px system-ui"},
        {...AXIS, size: 62},
      ],
      series: [{}, {stroke: () => colour("--link"), width: 1.3,
        points: {show: true, size: 4, fill: () => colour("--link"), filter: lone}}],
    }, this.data, this.element);
    onTheme(() => this.plot.redraw());
    this.observer = new ResizeObserver(() => this.plot.setSize(
      {width: this.element.clientWidth - 12, height: HEIGHT}));
    this.observer.observe(this.element);
  }

  add(rows, column) {
    const [times, values] = this.data;
    for (const row of rows) {
      times.push(row[0]);
      values.push(row[column]);
    }
    const first = times.findIndex((time) => time >= times[times.length - 1] - KEPT_S);
    this.data = [times.slice(first), values.slice(first)];
    this.plot.setData(this.data);
    this.element.dataset.points = this.data[0].length;
    this.last.textContent = number(values[values.length - 1], 5);
  }

  remove() {
    this.observer.disconnect();
    this.plot.destroy();
    this.element.remove();
  }
}
