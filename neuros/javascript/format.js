// Numbers and elements, as the page writes them.

export function number(value, digits = 3) {
  if (value === null || value === undefined) return "–";
  if (Number.isInteger(value) && Math.abs(value) < 1e10) return String(value);
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e7)) return value.toExponential(digits - 1);
  return String(Number(value.toPrecision(digits)));
}

export function percent(share) {
  return share === null || share === undefined ? "–" : `${Math.round(100 * share)} %`;
}

export function rate(perSecond) {
  return perSecond === null || perSecond === undefined ? "–" : number(perSecond, 3);
}

export function milliseconds(value) {
  return value === null || value === undefined ? "–" : `${number(value, 3)} ms`;
}

export function bytes(value) {
  return value >= 1e9 ? `${number(value / 1e9)} GB` : `${Math.round(value / 1e6)} MB`;
}

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

// A table row whose cells change in place: many times per second, and a click may be under way.
export class Row {
  constructor(body, name, columns) {
    this.cells = columns.map((kind) => element("td", kind ? {class: kind} : {}));
    this.row = element("tr", {"data-name": name}, ...this.cells);
    body.append(this.row);
  }

  show(...texts) {
    texts.forEach((text, place) => {
      const cell = this.cells[place];
      if (text instanceof Node) cell.replaceChildren(text);
      else if (cell.textContent !== text) cell.textContent = text;
    });
  }
}
