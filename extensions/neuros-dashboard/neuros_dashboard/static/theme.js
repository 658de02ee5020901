// Light or dark: as the system has it, unless the user of this browser has chosen.

const KEY = "neuros theme";
const root = document.documentElement;
const system = matchMedia("(prefers-color-scheme: dark)");

root.dataset.theme = localStorage.getItem(KEY) ?? "";

// A colour of the style sheet, such as "--ink", for what scripts draw.
export function colour(name) { return getComputedStyle(root).getPropertyValue(name); }

// Calls `draw` now, and whenever the colours become others.
export function onTheme(draw) {
  draw();
  system.addEventListener("change", draw);
  root.addEventListener("theme", draw);
}

document.querySelector("#theme").addEventListener("click", () => {
  const wasDark = (root.dataset.theme || (system.matches ? "dark" : "light")) === "dark";
  root.dataset.theme = wasDark ? "light" : "dark";
  if (wasDark !== system.matches) {
    localStorage.removeItem(KEY); // the system has it so, too
    root.dataset.theme = "";
  } else localStorage.setItem(KEY, root.dataset.theme);
  root.dispatchEvent(new Event("theme"));
});
