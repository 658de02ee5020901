// The page: a stream of events from the server, and who shows what of it.

import {Details} from "./details.js";
import {number} from "./format.js";
import {Graph} from "./graph.js";
import {Images} from "./images.js";
import {Layout} from "./layout.js";
import {showLoad} from "./load.js";
import {Log} from "./log.js";
import {Tables} from "./tables.js";
import * as wants from "./wants.js";
import {Worlds} from "./worlds.js";

const log = new Log();
let view = null;
let stream = null;
let hasEnded = false;
let lastFigures = null;

const handlers = {
  begin(plan) {
    log.clear();
    wants.begin(plan.page, plan.sources, plan.nodes.filter((node) => node.is_here));
    if (view) return view.layout.forget(); // the same run, seen again: layout and selection stay
    document.title = `${plan.project} – NeuROS`;
    document.querySelector("#project").textContent = plan.project;
    const images = new Images(plan.sources);
    const details = new Details(plan, (...array) => layout.draw(...array));
    const select = (kind, name) => { details.select(kind, name); view.tables.select(name); };
    view = {
      plan, details,
      graph: new Graph(document.querySelector("#graph"), plan, select),
      tables: new Tables(plan, select),
      images,
      worlds: new Worlds(),
    };
    const layout = view.layout = new Layout(plan, {images});
    images.onChange = () => layout.remember();
    window.neuros = view; // for the console of the browser
  },
  figures(figures) {
    lastFigures = figures;
    view.graph.show(figures);
    view.tables.show(figures);
    view.details.showFigures(figures);
    document.querySelector("#times").textContent = timesOf(view.plan, figures);
  },
  samples(samples) {
    for (const [name, sample] of Object.entries(samples)) {
      view.details.showSample(name, sample);
      view.images.show(name, sample);
      view.worlds.show(name, sample);
      view.layout.show(name, sample);
    }
  },
  phase(phase) {
    const shown = phase.is_paused ? "paused" : phase.phase;
    const isRunning = phase.phase === "running";
    hasEnded = phase.phase === "ended";
    showPhase(shown, hasEnded ? `ended: ${phase.reason} (exit code ${phase.exit_code})` : shown);
    enable({pause: isRunning && !phase.is_paused, resume: isRunning && phase.is_paused,
      step: isRunning && phase.is_paused, stop: isRunning});
  },
  log(lines) { log.add(lines); },
  load(load) { showLoad(load); },
};

// Which clock is where. In virtual time, a second of it is the one that the factor refers to.
function timesOf({is_virtual: isVirtual}, {sim_time: simS, virtual_s: virtualS, t, ...figures}) {
  const times = simS === null ? [] : [`simulated ${simS.toFixed(2)} s`];
  if (isVirtual) times.push(`virtual time ${virtualS.toFixed(2)} s`);
  else if (simS !== null) times.push(`${number(figures.real_time_factor, 3)} × real time`);
  return [...times, `wall clock ${t.toFixed(0)} s`].join(", ");
}

// Nobody says any more what the nodes do.
function forgetStates() {
  if (!lastFigures) return;
  const unknown = Object.keys(lastFigures.nodes).map((name) => [name, {state: "unknown"}]);
  handlers.figures({...lastFigures, nodes: Object.fromEntries(unknown)});
}

function showPhase(name, text) {
  const phase = document.querySelector("#phase");
  phase.className = name;
  phase.textContent = text;
}

function enable(buttons) {
  for (const [name, isOn] of Object.entries(buttons)) {
    document.querySelector(`#${name}`).disabled = !isOn;
  }
}

function open() {
  if (stream || hasEnded) return;
  stream = new EventSource("events");
  for (const [name, handle] of Object.entries(handlers)) {
    stream.addEventListener(name, (event) => handle(JSON.parse(event.data)));
  }
  stream.onerror = () => {
    if (hasEnded) close();
    else {
      showPhase("lost", "no connection");
      forgetStates();
      enable({pause: false, resume: false, step: false, stop: false});
    }
  };
}

function close() {
  stream?.close();
  stream = null;
}

function act(what, body = {}) {
  fetch(`do/${what}`, {method: "POST", body: JSON.stringify(body)}).catch(() => {});
}

document.querySelector("#pause").addEventListener("click", () => act("pause"));
document.querySelector("#resume").addEventListener("click", () => act("resume"));
document.querySelector("#step").addEventListener("click", () => act("step",
  {count: Math.max(1, Math.floor(Number(document.querySelector("#count").value) || 1))}));
document.querySelector("#stop").addEventListener("click", () => {
  if (confirm("End the run?")) act("stop");
});
// A page that nobody sees asks for nothing.
document.addEventListener("visibilitychange", () => document.hidden ? close() : open());
open();
