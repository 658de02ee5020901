// The end of the logs of all nodes, filtered.

import {element} from "./format.js";

const KEPT = 2000;
const RECORD = /^\[([A-Z]+)\] (?:\[([\d.]+)\] )?\[[^\]]+\]/;
const LEVELS = {DEBUG: 0, INFO: 1, WARN: 2, ERROR: 3, FATAL: 3};

export class Log {
  constructor() {
    this.box = document.querySelector("#log");
    this.filter = document.querySelector("#log-filter");
    this.severity = document.querySelector("#log-severity");
    this.lines = [];
    this.filter.addEventListener("input", () => this.refresh());
    this.severity.addEventListener("change", () => this.refresh());
  }

  clear() {
    this.lines = [];
    this.box.replaceChildren();
  }

  add(lines) {
    const isAtEnd = this.box.scrollHeight - this.box.scrollTop - this.box.clientHeight < 40;
    for (const record of lines) {
      const [, severity = "INFO", stampS] = RECORD.exec(record) ?? [];
      // Seconds since 1970 tell a reader nothing.
      const text = stampS ? record.replace(stampS, timeOfDay(1000 * stampS)) : record;
      const line = {text, severity};
      this.lines.push(line);
      if (this.shows(line)) this.box.append(lineElement(line));
    }
    this.lines.splice(0, Math.max(0, this.lines.length - KEPT));
    while (this.box.childElementCount > KEPT) this.box.firstElementChild.remove();
    if (isAtEnd) this.box.scrollTop = this.box.scrollHeight;
  }

  refresh() {
    this.box.replaceChildren(...this.lines.filter((line) => this.shows(line)).map(lineElement));
    this.box.scrollTop = this.box.scrollHeight;
  }

  shows(line) {
    if ((LEVELS[line.severity] ?? 1) < Number(this.severity.value)) return false;
    try {
      return new RegExp(this.filter.value, "i").test(line.text);
    } catch {
      return line.text.includes(this.filter.value); // an expression that is only half typed
    }
  }
}

function timeOfDay(ms) {
  const options = {hour12: false, hour: "2-digit", minute: "2-digit", second: "2-digit",
    fractionalSecondDigits: 3};
  return new Date(ms).toLocaleTimeString("en-GB", options);
}

function lineElement(line) {
  return element("div", {class: line.severity}, line.text);
}
