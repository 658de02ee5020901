// Camera images, small, a few times per second.

import {element} from "./format.js";
import {want} from "./wants.js";

const SHOWN_AT_FIRST = 2;

export class Images {
  constructor(sources) {
    const box = document.querySelector("#images");
    this.pictures = new Map();
    const images = sources.filter((source) => source.is_image);
    if (images.length) box.replaceChildren();
    images.forEach((source, place) => {
      const switched = element("input", {type: "checkbox"});
      switched.checked = place < SHOWN_AT_FIRST;
      switched.addEventListener("change", () => this.switch(source.name, switched.checked));
      const size = element("span");
      const image = element("img", {alt: source.title});
      box.append(element("div", {class: "picture", "data-source": source.name},
        element("h3", {}, element("label", {}, switched, ` ${source.title}`), size), image));
      this.pictures.set(source.name, {image, size});
      this.switch(source.name, switched.checked);
    });
  }

  switch(name, isOn) {
    want(name, (entry) => { entry.image = isOn; });
    this.pictures.get(name).image.hidden = !isOn;
  }

  show(name, sample) {
    const picture = this.pictures.get(name);
    if (!picture) return;
    if (sample.fault) picture.size.textContent = sample.fault;
    if (!sample.image) return;
    picture.image.src = sample.image.url ?? "";
    const [width, height] = sample.image.of;
    picture.size.textContent = `${width ? `${width} × ${height} ` : ""}${sample.image.encoding}`;
  }
}
