// Activity over a population as a heat map over time, with its peak marked: the bump of a ring.

import {element, number} from "./format.js";
import {Plane} from "./plane.js";
import {binOf, buffer, SpikeTrain} from "./spikes.js";

const COLUMNS = 100;
const MOST_ROWS = 256;
const SMOOTH_SHARE = 1 / 16;
export const LEAST_RING = 8; // with fewer numbers, the largest one is no bump
const COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const PEAK = "#ffffff";

export class Activity {
  static title = "Activity";
  static fits = (source) => source.is_spikes || source.array !== "";
  static wants = (source, {field = source.array}) => source.is_spikes && !field
    ? {spikes: true} : {array: field};

  constructor(box, {seconds = 10, field}, source, clock = "wall clock") {
    this.seconds = seconds;
    this.clock = clock; // of arrays; spikes have times of their own
    this.field = field ?? source.array;
    this.canvas = element("canvas", {class: "body"});
    box.append(this.canvas);
    this.plane = new Plane(this.canvas, () => this.draw());
    this.train = new SpikeTrain(1.5 * seconds);
    this.rows = []; // of arrays: {timeS, values}
  }

  show(sample) {
    if (sample.spikes && !this.field) this.train.add(sample.spikes);
    else if (sample.arrays?.[this.field]) this.take(sample.arrays[this.field]);
    else return null;
    this.draw();
    if (!this.size) return "empty";
    const cut = this.length > this.size ? `; of ${this.length}, the first ${this.size}` : "";
    const peak = this.peak === null ? `${this.size} numbers` : `peak at ${this.peak} of ${this.size}`;
    return `${peak}, ${number(this.low)} to ${number(this.high)}${cut}`;
  }

  forget() {
    this.train.forget();
    this.rows = [];
  }

  take(rows) {
    for (const [timeS, values, length] of rows) {
      this.put(timeS, new Float32Array(buffer(values)));
      this.length = length;
    }
  }

  put(timeS, values) {
    if (this.rows.length && timeS < this.rows.at(-1).timeS - this.seconds) this.rows = [];
    this.rows.push({timeS, values});
    const firstS = timeS - this.seconds;
    while (this.rows[0].timeS < firstS) this.rows.shift();
  }

  // Columns {timeS, values}, oldest first, and how many neurons or elements there are.
  columns() {
    if (this.rows.length) {
      const endS = this.rows.at(-1).timeS;
      return {columns: this.rows, endS, size: this.rows.at(-1).values.length};
    }
    const {train, seconds} = this;
    if (train.endS === null) return {columns: [], endS: null, size: 0};
    const binS = seconds / COLUMNS;
    const rows = Math.min(MOST_ROWS, Math.max(1, train.size));
    const first = Math.ceil(Math.max(train.endS - seconds, train.beginS) / binS);
    const last = binOf(train.endS, binS); // whole bins
    const columns = Array.from({length: Math.max(0, last - first)},
      (_, place) => ({timeS: (first + place + 0.5) * binS, values: new Float32Array(rows)}));
    const each = rows / (Math.max(1, train.size) * binS);
    train.each(first * binS, last * binS, (sender, timeS) => {
      const column = columns[binOf(timeS, binS) - first];
      if (column) column.values[Math.floor(sender * rows / train.size)] += each;
    });
    return {columns, endS: train.endS, size: train.size};
  }

  draw() {
    const {plane, seconds} = this;
    plane.clear();
    const {columns, endS, size} = this.columns();
    [this.size, this.peak] = [size, null];
    if (!columns.length) return;
    const beginS = endS - seconds;
    [this.low, this.high] = [Infinity, -Infinity];
    for (const {values} of columns) {
      for (const value of values) {
        if (!Number.isFinite(value)) continue;
        if (value < this.low) this.low = value;
        if (value > this.high) this.high = value;
      }
    }
    const picture = plane.picture(plane.height);
    const pixels = new Uint32Array(picture.data.buffer);
    const colours = palette();
    const scale = this.high > this.low ? 255 / (this.high - this.low) : 0;
    const x = (timeS) => plane.width * (timeS - beginS) / seconds;
    columns.forEach(({timeS, values}, place) => {
      // A column reaches half the way to its neighbours.
      const left = place ? (columns[place - 1].timeS + timeS) / 2 : timeS;
      const right = place < columns.length - 1 ? (columns[place + 1].timeS + timeS) / 2 : timeS;
      const [from, to] = [Math.max(0, Math.floor(x(left))), Math.min(plane.width, Math.ceil(x(right)) + 1)];
      for (let row = 0; row < plane.height; row++) {
        const cell = Math.floor(values.length * (1 - (row + 1) / plane.height));
        const value = values[Math.max(0, cell)];
        if (!Number.isFinite(value)) continue; // stays white
        pixels.fill(colours[Math.round((value - this.low) * scale)],
          row * plane.width + from, row * plane.width + to);
      }
    });
    plane.paint(picture, 0);
    const peaks = columns.map(({timeS, values}) => [timeS, peakOf(values), values.length])
      .filter(([, peak, length]) => peak !== null && length >= LEAST_RING);
    plane.dots(peaks.map(([timeS, peak, length]) =>
      [x(timeS), plane.height * (1 - (peak + 0.5) / length)]), PEAK, 3);
    if (peaks.length) {
      const [, peak, length] = peaks.at(-1);
      this.peak = Math.floor((peak + 0.5) * size / length);
      this.canvas.dataset.peak = this.peak;
    }
    plane.levels(0, plane.height, String(size - 1), "0",
      this.rows.length ? "element" : "neuron");
    plane.times(beginS, endS, this.rows.length ? this.clock : "time of spikes");
    this.canvas.dataset.columns = columns.length;
  }

  remove() { this.plane.remove(); }
}

// Where a ring of values is largest, smoothed over a sixteenth of it: the middle of the places that
// are; null where all are equal.
export function peakOf(values) {
  const reach = Math.floor(values.length * SMOOTH_SHARE / 2);
  const at = (place) => {
    const value = values[(place + values.length) % values.length];
    return Number.isFinite(value) ? value : 0;
  };
  let sum = 0;
  for (let place = -reach; place <= reach; place++) sum += at(place);
  let [best, first, count, least] = [-Infinity, 0, 0, Infinity];
  for (let next = 0; next < values.length; next++) {
    const margin = 1e-6 * Math.abs(best);
    if (!(sum <= best + margin)) [best, first, count] = [sum, next, 1];
    else if (sum >= best - margin && next === first + count) count += 1;
    least = Math.min(least, sum);
    sum += at(next + reach + 1) - at(next - reach);
  }
  return best - least > 1e-6 * Math.abs(best) ? first + (count - 1) / 2 : null;
}

let made = null;

// 256 colours, as pixels.
function palette() {
  made ??= Uint32Array.from({length: 256}, (_, level) => {
    const where = level / 255 * (COLOURS.length - 1);
    const first = Math.min(COLOURS.length - 2, Math.floor(where));
    const mixed = COLOURS[first].map(
      (channel, place) => channel + (COLOURS[first + 1][place] - channel) * (where - first));
    return new Uint32Array(Uint8Array.of(...mixed, 255).buffer)[0];
  });
  return made;
}
