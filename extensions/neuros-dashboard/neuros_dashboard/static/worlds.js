// The simulated worlds of a run, one at a time: poses come in bundles, and are played smoothly.

import {element} from "./format.js";
import {Scene, floats} from "./scene.js";
import {want, WORLD} from "./wants.js";

const LIBRARY = "static/vendor/three.iife.min.js";
const FRAME_MS = 1000 / 31; // of a screen with 60 Hz, every second frame
const FRESH_MS = 1000;

export class Worlds {
  constructor() {
    const at = (id) => document.querySelector(`#world${id}`);
    [this.section, this.box, this.fault] = [at("-section"), at(""), at("-fault")];
    [this.shown, this.node, this.camera] = [at("-shown"), at("-node"), at("-camera")];
    [this.sites, this.contacts] = [at("-sites"), at("-contacts")];
    this.versions = new Map(); // by source, what its node has
    this.isInView = false;
    this.shown.addEventListener("change", () => this.switch());
    this.contacts.addEventListener("change", () => this.switch());
    this.sites.addEventListener("change", () => this.scene?.showSites(this.sites.checked));
    this.camera.addEventListener("change",
      () => this.scene?.look(this.scene.views.get(this.camera.value)));
    this.node.addEventListener("change", () => {
      this.camera.replaceChildren();
      this.load();
    });
    new IntersectionObserver((seen) => {
      this.isInView = seen.at(-1).isIntersecting;
      this.switch();
    }).observe(this.section);
    this.player = new Player();
    this.tick = this.tick.bind(this);
  }

  get source() { return this.node.value; }

  // A sample of a node's world: which version it has, and how it has moved.
  show(name, {version, frames, fault}) {
    if (!name.endsWith(WORLD)) return;
    if (fault) this.fault.textContent = fault;
    if (!version) return;
    if (!this.versions.has(name)) {
      this.node.append(element("option", {value: name}, name.slice(0, -WORLD.length - 1)));
      this.node.hidden = this.node.length < 2;
      this.section.hidden = false;
    }
    this.versions.set(name, version);
    if (name !== this.source) return;
    if (frames) this.player.add(frames);
    const isFresh = performance.now() - this.loadedMs < FRESH_MS;
    if (this.isOn && this.isStale && !isFresh) this.load();
  }

  get isStale() {
    return this.name !== this.source || this.version !== this.versions.get(this.source);
  }

  get isOn() { return this.shown.checked && this.isInView; }

  // Nodes note poses only while somebody sees them.
  switch() {
    this.box.hidden = !this.shown.checked;
    for (const name of this.versions.keys()) {
      want(name, (entry) => {
        entry.frames = this.isOn && name === this.source;
        entry.contacts = this.contacts.checked;
      });
    }
    if (!this.isOn) return;
    if (this.isStale) this.load();
    if (!this.isTicking) requestAnimationFrame(this.tick);
    this.isTicking = true;
  }

  // The geometry of the chosen node, whenever there is another one.
  async load() {
    const name = this.source;
    if (this.isLoading) return;
    this.isLoading = true;
    try {
      await library();
      const node = name.slice(0, -WORLD.length - 1);
      const answer = await fetch(`world/${encodeURIComponent(node)}`);
      if (!answer.ok) throw new Error(`the geometry does not come (${answer.status})`);
      const geometry = await answer.json();
      const [scene, before] = [await Scene.make(this.box, geometry), this.scene];
      if (before && this.name === name) scene.lookAs(before);
      before?.dispose();
      [this.scene, this.name, this.version] = [scene, name, geometry.version];
      this.player = new Player();
      this.fault.textContent = "";
      scene.showSites(this.sites.checked);
      const chosen = this.camera.value;
      this.camera.replaceChildren(...[...scene.views.keys()].map((each) => new Option(each)));
      if (scene.views.has(chosen)) this.camera.value = chosen;
      scene.look(scene.views.get(this.camera.value));
    } catch (error) {
      this.fault.textContent = error.message;
      [this.name, this.version] = [name, this.versions.get(name)]; // until there is another one
    }
    this.isLoading = false;
    this.loadedMs = performance.now();
    this.switch();
  }

  tick(nowMs) {
    this.isTicking = this.isOn;
    if (!this.isOn) return;
    requestAnimationFrame(this.tick);
    if (!this.scene || nowMs - (this.drawnMs ?? 0) < FRAME_MS) return;
    this.player.play(this.scene, nowMs);
    if (!this.scene.draw()) return;
    this.drawnMs = nowMs;
    this.box.dataset.drawn = Number(this.box.dataset.drawn ?? 0) + 1;
  }
}

// Plays frames as far apart as they were taken, as late as bundles of them are apart.
class Player {
  constructor() {
    this.frames = [];
    this.offset = Infinity; // of our clock to that of the node, in seconds
    this.gap = 0;
    this.still = null; // what is placed, while it does not move
  }

  add(frames) {
    const nowS = performance.now() / 1000;
    for (const [timeS, , text, contacts = ""] of frames) {
      this.offset = Math.min(this.offset, nowS - timeS);
      this.frames.push(
        {timeS, text: text + contacts, poses: floats(text), contacts: floats(contacts)});
    }
    if (this.lastS) this.gap = Math.max(0.9 * this.gap, Math.min(1, nowS - this.lastS));
    this.lastS = nowS;
  }

  play(scene, nowMs) {
    const timeS = nowMs / 1000 - this.offset - 1.2 * this.gap;
    while (this.frames.length > 1 && this.frames[1].timeS <= timeS) this.frames.shift();
    const [first, second = first] = this.frames;
    const isStill = first?.text === second?.text;
    if (!first || (isStill && first.text === this.still)) return;
    const share = (timeS - first.timeS) / (second.timeS - first.timeS || 1);
    scene.place(first.poses, second.poses, Math.max(0, Math.min(1, share)));
    scene.touch(first.contacts);
    this.still = isStill ? first.text : null;
  }
}

let loading = null;

// Three.js is loaded when there is a world to show.
function library() {
  loading ??= new Promise((resolve, reject) => {
    const script = element("script", {src: LIBRARY, onload: resolve,
      onerror: () => reject(new Error(`${LIBRARY} cannot be loaded`))});
    document.head.append(script);
  });
  return loading;
}
