// A canvas with time to the right, and the tick marks around it.

const [LEFT, RIGHT, TOP, BOTTOM] = [46, 6, 4, 18];
const TICKS = 5;

export class Plane {
  constructor(canvas, onResize) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.observer = new ResizeObserver(onResize);
    this.observer.observe(canvas);
  }

  get width() { return this.canvas.width - LEFT - RIGHT; }
  get height() { return this.canvas.height - TOP - BOTTOM; }

  // Empties it, and gives it the size that it has on the page.
  clear() {
    this.canvas.width = Math.max(LEFT + RIGHT + 10, this.canvas.clientWidth);
    this.canvas.height = Math.max(TOP + BOTTOM + 10, this.canvas.clientHeight);
    this.context.font = "11px system-ui, sans-serif";
    this.context.fillStyle = this.ink = getComputedStyle(this.canvas).color;
  }

  // Times below the plane, in seconds, and of which clock they are.
  times(beginS, endS, clock) {
    const step = stepOf((endS - beginS) / TICKS);
    const digits = Math.max(0, -Math.floor(Math.log10(step)));
    const y = this.canvas.height - 4;
    this.context.textAlign = "right";
    this.context.fillText(clock, this.canvas.width, y);
    const rightEnd = this.canvas.width - this.context.measureText(clock).width - 8;
    this.context.textAlign = "center";
    for (let tick = Math.ceil(beginS / step) * step; tick <= endS; tick += step) {
      const x = LEFT + this.width * (tick - beginS) / (endS - beginS);
      const label = `${tick.toFixed(digits)} s`;
      const half = this.context.measureText(label).width / 2;
      if (x + half < rightEnd) this.context.fillText(label, x, y);
    }
  }

  // What the top and the bottom of a part of the plane are; y from 0 to height.
  levels(top, bottom, high, low, name) {
    this.context.textAlign = "right";
    this.context.fillText(high, LEFT - 4, TOP + top + 9);
    if (low !== "") this.context.fillText(low, LEFT - 4, TOP + bottom);
    this.context.save();
    this.context.translate(11, TOP + (top + bottom) / 2);
    this.context.rotate(-Math.PI / 2);
    this.context.textAlign = "center";
    this.context.fillText(name, 0, 0);
    this.context.restore();
  }

  // An empty picture for a part of the plane; `paint` puts it there.
  picture(height) { return this.context.createImageData(this.width, Math.max(1, height)); }

  paint(picture, top) { this.context.putImageData(picture, LEFT, TOP + top); }

  // A line through points [x, y] of the plane; a y of null interrupts it.
  line(points, colour) {
    this.context.beginPath();
    let isDrawing = false;
    for (const [x, y] of points) {
      if (y === null) isDrawing = false;
      else if (isDrawing) this.context.lineTo(LEFT + x, TOP + y);
      else {
        this.context.moveTo(LEFT + x, TOP + y);
        isDrawing = true;
      }
    }
    this.context.strokeStyle = colour;
    this.context.lineWidth = 1.3;
    this.context.stroke();
  }

  // Marks points [x, y] of the plane.
  dots(points, colour, size) {
    this.context.fillStyle = colour;
    for (const [x, y] of points) {
      this.context.fillRect(LEFT + x - size / 2, TOP + y - size / 2, size, size);
    }
    this.context.fillStyle = this.ink;
  }

  remove() { this.observer.disconnect(); }
}

// 1, 2 or 5 times a power of ten, at least as large.
function stepOf(size) {
  const power = 10 ** Math.floor(Math.log10(size || 1));
  return power * [1, 2, 5, 10].find((each) => each * power >= size * 0.999);
}
