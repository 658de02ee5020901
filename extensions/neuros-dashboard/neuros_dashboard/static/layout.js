// Which panels the page has, in which order and how large; the user changes it with "Layout".

import {Activity} from "./activity.js";
import {element} from "./format.js";
import {Raster} from "./raster.js";
import {want} from "./wants.js";

const OUTPUT_PANELS = {raster: Raster, activity: Activity};
const WIDTHS = ["narrow", "wide", "full"]; // one, two and three thirds of the page
const RASTERS_AT_FIRST = 2;
const AT_FIRST = [
  ["world", "full"], ["graph", "wide"], ["details", "narrow"], ["connections", "wide"],
  ["nodes", "narrow"], ["images", "full"], ["log", "wide"],
  ["load", "narrow"],
];

export class Layout {
  // `contents` are the parts of the page with choices of their own: they have `enable(isOn)`,
  // `choose(keys)` for what a layout says of them, and `chosen()` for what it is to say.
  constructor(plan, contents) {
    this.plan = plan;
    this.contents = contents;
    this.main = document.querySelector("main");
    this.sections = new Map([...document.querySelectorAll("main > section")].map(
      (section) => [section.dataset.panel, section]));
    this.key = `neuros layout ${plan.project}`;
    this.panels = [];
    for (const [name, section] of this.sections) section.append(this.tools(() => this.panels
      .find((each) => each.panel === name)));
    const at = (id) => document.querySelector(`#layout-${id}`);
    [this.added, this.text] = [at("panel"), at("text")];
    document.querySelector("#layout").addEventListener("click", () => {
      at("bar").hidden = !document.body.classList.toggle("editing");
    });
    at("add").addEventListener("click", () => this.add(this.added.value));
    at("reset").addEventListener("click", () => this.reset());
    at("copy").addEventListener("click", () => this.copy(at("copy")));
    at("save").addEventListener("click", () => this.save());
    this.use(this.remembered() ?? this.ofProject);
  }

  get ofProject() { return this.plan.dashboard?.panels ?? this.panelsAtFirst; }

  get panelsAtFirst() {
    const rasters = this.plan.sources.filter((source) => source.is_spikes);
    const hasImages = this.plan.sources.some((source) => source.is_image);
    const panels = AT_FIRST.filter(([panel]) => hasImages || panel !== "images").map(
      ([panel, width]) => ({panel, width}));
    panels.splice(3, 0, ...rasters.slice(0, RASTERS_AT_FIRST).map(
      (source) => ({panel: "raster", output: source.name, width: "full"})));
    return panels;
  }

  // What the user has changed in this browser, unless the project has another layout since then.
  remembered() {
    try {
      const {of, panels} = JSON.parse(localStorage.getItem(this.key));
      return of === JSON.stringify(this.plan.dashboard ?? null) ? panels : null;
    } catch {
      return null;
    }
  }

  // The layout, as the project file has it.
  get written() {
    return this.panels.map(({section, content, fields, outputs, ...keys}) => (
      {...keys, ...this.contents[keys.panel]?.chosen()}));
  }

  note() {
    this.text.value = `"dashboard": ${format({panels: this.written})}`;
    this.added.replaceChildren(
      ...[...this.sections.keys()].filter((name) => !this.panels.some((p) => p.panel === name))
        .map((name) => new Option(name, name)),
      ...Object.entries(OUTPUT_PANELS).flatMap(([kind, {fits}]) => this.plan.sources.filter(fits)
        .map((source) => new Option(`${kind} of ${source.title}`, `${kind} ${source.name}`))));
  }

  changed() {
    this.arrange();
    this.note();
    this.remember();
  }

  remember() {
    this.text.value = `"dashboard": ${format({panels: this.written})}`;
    localStorage.setItem(this.key, JSON.stringify(
      {of: JSON.stringify(this.plan.dashboard ?? null), panels: this.written}));
  }

  // Show these panels, and no others.
  use(panels) {
    for (const panel of this.panels) panel.content?.remove();
    this.panels = panels.filter(({panel}) => this.sections.has(panel) || OUTPUT_PANELS[panel])
      .map((keys) => ({...keys}));
    for (const panel of this.panels) this.contents[panel.panel]?.choose(panel);
    this.arrange();
    this.note();
  }

  arrange() {
    const here = new Set(this.panels.map((each) => each.panel));
    for (const [name, section] of this.sections) {
      section.classList.toggle("off", !here.has(name));
      this.contents[name]?.enable(here.has(name));
    }
    for (const panel of this.panels) {
      panel.section = this.sections.get(panel.panel);
      if (!panel.section) {
        panel.content ??= new OutputPanel(panel, this);
        panel.section = panel.content.section;
      }
      for (const width of WIDTHS) {
        panel.section.classList.toggle(width, width === (panel.width ?? "narrow"));
      }
      const body = panel.section.querySelector(".body");
      const height = panel.height ? `${panel.height}px` : "";
      Object.assign(body.style, {height, maxHeight: height});
      panel.section.querySelector(".tools select").value = panel.width ?? "narrow";
      panel.section.querySelector(".tools input").value = panel.height ?? "";
      this.main.append(panel.section);
    }
  }

  // The buttons of one panel, which are seen while the layout is changed.
  tools(find) {
    const button = (text, title, onclick) => element("button", {title, onclick}, text);
    const width = element("select", {"aria-label": "width", onchange: () => {
      find().width = width.value;
      this.changed();
    }}, ...WIDTHS.map((each) => new Option(each)));
    const height = element("input", {type: "number", min: 80, max: 2000, step: 20,
      placeholder: "height", "aria-label": "height in pixels", onchange: () => {
        const asked = Math.round(Number(height.value));
        if (asked) find().height = Math.max(80, Math.min(2000, asked));
        else delete find().height;
        this.changed();
      }});
    return element("div", {class: "tools"},
      button("←", "earlier", () => this.move(find(), -1)),
      button("→", "later", () => this.move(find(), 1)),
      width, height, button("×", "hide this panel", () => this.hide(find())));
  }

  move(panel, way) {
    const from = this.panels.indexOf(panel);
    const to = Math.max(0, Math.min(this.panels.length - 1, from + way));
    this.panels.splice(from, 1);
    this.panels.splice(to, 0, panel);
    this.changed();
  }

  hide(panel) {
    this.panels.splice(this.panels.indexOf(panel), 1);
    panel.content?.remove();
    this.changed();
  }

  add(what) {
    if (!what) return;
    const space = what.indexOf(" ");
    if (space < 0) {
      const width = AT_FIRST.find(([panel]) => panel === what)[1];
      this.panels.push({panel: what, width});
    } else {
      this.panels.push({panel: what.slice(0, space), output: what.slice(space + 1), width: "wide"});
    }
    this.changed();
    this.panels.at(-1).section.scrollIntoView({block: "center"});
  }

  // A heat map of an array that the user has clicked.
  draw(output, field) {
    this.panels.push({panel: "activity", output, field, width: "wide"});
    this.changed();
    this.panels.at(-1).section.scrollIntoView({block: "center"});
  }

  reset() {
    localStorage.removeItem(this.key);
    this.use(this.ofProject);
  }

  async copy(button) {
    this.text.select();
    try {
      await navigator.clipboard.writeText(this.text.value);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Press Ctrl+C"; // the text is selected
    }
    setTimeout(() => { button.textContent = "Copy"; }, 2000);
  }

  save() {
    const url = URL.createObjectURL(new Blob(
      [`${format({dashboard: {panels: this.written}})}\n`], {type: "application/json"}));
    element("a", {href: url, download: `${this.plan.project}-dashboard.json`}).click();
    setTimeout(() => URL.revokeObjectURL(url));
  }

  // The page was not seen for a while.
  forget() {
    for (const {content} of this.panels) content?.forget();
  }

  show(name, sample) {
    for (const {content} of this.panels) content?.show(name, sample);
  }
}

// A panel that draws one output. Its node is asked only while the panel can be seen.
class OutputPanel {
  constructor(panel, layout) {
    [this.panel, this.layout] = [panel, layout];
    this.kind = OUTPUT_PANELS[panel.panel];
    const fitting = layout.plan.sources.filter(
      (source) => this.kind.fits(source) || source.name === panel.output);
    this.chooser = element("select", {"aria-label": "output", onchange: () => {
      panel.output = this.chooser.value;
      delete panel.field;
      this.open();
      layout.changed();
    }}, ...fitting.map((source) => new Option(source.title, source.name)));
    this.chooser.value = panel.output;
    this.told = element("span", {}, "no packet yet");
    this.box = element("div");
    this.section = element("section", {"data-panel": panel.panel},
      element("h2", {}, `${this.kind.title} `, this.chooser, " ", this.told), this.box,
      layout.tools(() => panel));
    this.observer = new IntersectionObserver((seen) => this.look(seen.at(-1).isIntersecting));
    this.open();
    this.observer.observe(this.section);
  }

  open() {
    const isSeen = this.isSeen ?? false;
    this.look(false);
    this.drawn?.remove();
    this.box.replaceChildren();
    const {plan} = this.layout;
    this.source = plan.sources.find((source) => source.name === this.panel.output);
    if (this.panel.field) this.told.textContent = `${this.panel.field}: no packet yet`;
    this.drawn = null;
    if (!this.source) {
      this.box.append(element("p", {class: "body"},
        `${this.panel.output}: its node is not part of this run`));
      return;
    }
    this.drawn = new this.kind(this.box, this.panel, this.source);
    this.look(isSeen);
  }

  forget() { this.drawn?.forget(); }

  look(isSeen) {
    // What passed meanwhile is not known.
    if (isSeen && !this.isSeen) this.drawn?.forget();
    this.isSeen = isSeen;
    if (!this.source) return;
    want(this.source.name, (entry) => {
      if (isSeen) entry.claims.set(this, this.kind.wants(this.source, this.panel));
      else entry.claims.delete(this);
    });
  }

  show(name, sample) {
    if (!this.drawn || name !== this.source.name) return;
    const text = sample.fault ?? this.drawn.show(sample);
    if (text !== null) this.told.textContent = [this.panel.field, text].filter(Boolean).join(": ");
  }

  remove() {
    this.look(false);
    this.observer.disconnect();
    this.drawn?.remove();
    this.section.remove();
  }
}

// JSON with one panel per line.
function format(value, indent = "  ") {
  if (Array.isArray(value)) {
    return value.length ? `[\n${value.map((each) => indent + line(each)).join(",\n")}\n${indent.slice(2)}]` : "[]";
  }
  const members = Object.entries(value).map(
    ([key, each]) => `${indent}${JSON.stringify(key)}: ${typeof each === "object"
      ? format(each, `${indent}  `) : line(each)}`);
  return `{\n${members.join(",\n")}\n${indent.slice(2)}}`;
}

function line(value) {
  return JSON.stringify(value, null, 1).replace(/\n\s*/g, " ");
}
