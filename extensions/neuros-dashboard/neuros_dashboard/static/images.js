// Camera images, small, a few times per second.

import {element} from "./format.js";
import {want} from "./wants.js";

const SHOWN_AT_FIRST = 2;

export class Images {
  constructor(sources) {
    const box = document.querySelector("#images");
    this.pictures = new Map();
    this.isOn = true;
    const images = sources.filter((source) => source.is_image);
    if (images.length) box.replaceChildren();
    images.forEach((source, place) => {
      const switched = element("input", {type: "checkbox"});
      switched.checked = place < SHOWN_AT_FIRST;
      switched.addEventListener("change", () => {
        this.switch(source.name);
        this.onChange?.();
      });
      const size = element("span");
      const image = element("img", {alt: source.title});
      const none = element("p", {class: "none"}, "no picture yet");
      box.append(element("div", {class: "picture", "data-source": source.name},
        element("h3", {}, element("label", {}, switched, ` ${source.title}`), size), image, none));
      this.pictures.set(source.name, {image, none, size, switched});
    });
    this.atFirst = images.slice(0, SHOWN_AT_FIRST).map((source) => source.name);
  }

  switch(name) {
    const {image, none, switched} = this.pictures.get(name);
    want(name, (entry) => { entry.image = this.isOn && switched.checked; });
    image.hidden = !switched.checked;
    none.hidden = image.hidden || image.hasAttribute("src");
  }

  // Whether the page shows this panel.
  enable(isOn) {
    this.isOn = isOn;
    for (const name of this.pictures.keys()) this.switch(name);
  }

  // Of a layout: the outputs to show.
  choose({outputs = this.atFirst}) {
    for (const [name, {switched}] of this.pictures) switched.checked = outputs.includes(name);
  }

  chosen() {
    const outputs = [...this.pictures].filter(([, {switched}]) => switched.checked);
    const names = outputs.map(([name]) => name);
    return String(names) === String(this.atFirst) ? {} : {outputs: names};
  }

  show(name, sample) {
    const picture = this.pictures.get(name);
    if (!picture) return;
    if (sample.fault) picture.none.textContent = sample.fault;
    if (!sample.image) return;
    const {url, of: [width, height], encoding} = sample.image;
    if (url) picture.image.src = url;
    else picture.none.textContent = `a browser shows no image in the format ${encoding}`;
    picture.none.hidden = Boolean(url) || picture.image.hidden;
    picture.size.textContent = `${width ? `${width} × ${height} ` : ""}${encoding}`;
  }
}
