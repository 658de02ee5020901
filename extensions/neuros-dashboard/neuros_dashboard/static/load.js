// The load of the machine, core by core, and of each node.

import {bytes, element} from "./format.js";

export function showLoad(load) {
  const rows = load.cores.map((percent, core) => element("tr", {},
    element("td", {}, `core ${core}`), element("td", {}, bar(percent)),
    element("td", {class: "number"}, `${Math.round(percent)} %`)));
  rows.push(element("tr", {}, element("td", {}, "memory"), element("td", {}, bar(load.memory_percent)),
    element("td", {class: "number"}, bytes(load.memory_used_bytes))));
  for (const [name, each] of Object.entries(load.groups)) {
    rows.push(element("tr", {"data-name": name}, element("td", {}, name),
      element("td", {}, bar(each.cpu_percent)),
      element("td", {class: "number"},
        `${Math.round(each.cpu_percent)} %, ${bytes(each.memory_bytes)}, ${each.threads} threads`)));
  }
  document.querySelector("#load").replaceChildren(element("table", {}, ...rows));
}

function bar(percent) {
  const fill = element("i");
  fill.style.width = `${Math.min(100, percent)}%`;
  return element("div", {class: "bar"}, fill);
}
