// Time series of chosen fields: the last minute, one chart per field.

import {element, number} from "./format.js";
import {want} from "./wants.js";

const KEPT_S = 60;
const HEIGHT = 150;

export class Series {
  constructor(project) {
    this.box = document.querySelector("#series");
    this.hint = document.querySelector("#series-hint");
    this.charts = new Map();
    this.key = `neuros series ${project}`;
  }

  // What was plotted when this project was last looked at in this browser.
  restore() {
    for (const [source, path] of JSON.parse(localStorage.getItem(this.key) ?? "[]")) {
      if (!this.has(source, path)) this.toggle(source, path);
    }
  }

  has(source, path) { return this.charts.has(`${source} ${path}`); }

  toggle(source, path) {
    const key = `${source} ${path}`;
    const chart = this.charts.get(key);
    if (chart) {
      chart.remove();
      this.charts.delete(key);
    } else {
      this.charts.set(key, new Chart(this.box, source, path, () => this.toggle(source, path)));
    }
    want(source, (entry) => chart ? entry.fields.delete(path) : entry.fields.add(path));
    this.hint.hidden = this.charts.size > 0;
    localStorage.setItem(this.key,
      JSON.stringify([...this.charts.values()].map((each) => [each.source, each.path])));
    return !chart;
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
      scales: {x: {time: false}, y: {range: rangeOf}}, axes: [{size: 28}, {size: 62}],
      series: [{}, {stroke: "#1a66c2", width: 1.3, points: {show: false}}],
    }, this.data, this.element);
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
