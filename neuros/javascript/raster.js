// Spike raster of a population, and below it the population's rate.

import {element, number} from "./format.js";
import {Plane} from "./plane.js";
import {binOf, SpikeTrain} from "./spikes.js";

const BINS = 100;
const RASTER_SHARE = 0.7;
const INK = [0x1a, 0x66, 0xc2];

export class Raster {
  static title = "Spikes";
  static fits = (source) => source.is_spikes;
  static wants = () => ({spikes: true});

  constructor(box, {seconds = 5}) {
    this.seconds = seconds;
    this.canvas = element("canvas", {class: "body"});
    box.append(this.canvas);
    this.plane = new Plane(this.canvas, () => this.draw());
    this.train = new SpikeTrain(1.5 * seconds);
  }

  // Takes a sample; returns what to write beside the title.
  show(sample) {
    if (!sample.spikes) return null;
    this.train.add(sample.spikes);
    this.draw();
    const {size, missing} = this.train;
    if (missing > 0) return `${size} neurons; too many spikes: not all of them are shown`;
    return `${size} neurons, ${number(this.rate, 3)} spikes/s each`;
  }

  forget() { this.train.forget(); }

  draw() {
    const {plane, train, seconds} = this;
    plane.clear();
    if (train.endS === null) return;
    const [endS, beginS] = [train.endS, train.endS - seconds];
    const size = Math.max(1, train.size);
    const high = Math.round(plane.height * RASTER_SHARE);
    const picture = plane.picture(high);
    const pixels = new Uint32Array(picture.data.buffer);
    const ink = new Uint32Array(Uint8Array.of(...INK, 255).buffer)[0];
    const tall = Math.max(1, Math.min(4, Math.floor(high / size)));
    const binS = seconds / BINS;
    const firstBin = Math.ceil(Math.max(beginS, train.beginS) / binS);
    const counts = new Uint32Array(Math.max(1, binOf(endS, binS) - firstBin)); // whole bins
    let drawn = 0;
    train.each(beginS, endS, (sender, timeS) => {
      drawn += 1;
      const bin = binOf(timeS, binS) - firstBin;
      if (bin >= 0 && bin < counts.length) counts[bin] += 1;
      const x = Math.min(plane.width - 1, Math.floor(plane.width * (timeS - beginS) / seconds));
      const y = Math.floor(high * (1 - (sender + 1) / size));
      for (let row = y; row < Math.min(high, y + tall); row++) pixels[row * plane.width + x] = ink;
    });
    plane.paint(picture, 0);
    plane.levels(0, high, String(size - 1), "0", "neuron");
    const rates = Array.from(counts, (count) => count / size / binS);
    const most = Math.max(1, ...rates);
    const [top, bottom] = [high + 8, plane.height];
    plane.levels(top, bottom, number(most, 3), "0", "1/s");
    plane.line(rates.map((each, place) => [
      plane.width * ((firstBin + place + 0.5) * binS - beginS) / seconds,
      bottom - (bottom - top) * each / most]), "#c2571a");
    plane.times(beginS, endS, "time of spikes");
    this.rate = rates.slice(-BINS / 5).reduce((sum, each) => sum + each, 0)
      / Math.min(BINS / 5, rates.length);
    this.canvas.dataset.spikes = drawn;
    this.canvas.dataset.rate = this.rate;
  }

  remove() { this.plane.remove(); }
}
