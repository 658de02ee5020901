// Draws all diagrams of a page, in the colours that the reader has chosen, and again when these change.
"use strict";

const preference = window.matchMedia("(prefers-color-scheme: dark)");

function isDark() {
  const chosen = document.body.dataset.theme;
  return chosen === "dark" || (chosen !== "light" && preference.matches);
}

async function draw() {
  const diagrams = document.querySelectorAll("pre.mermaid");
  for (const diagram of diagrams) {
    diagram.dataset.source ??= diagram.textContent;
    diagram.textContent = diagram.dataset.source;
    delete diagram.dataset.processed;
  }
  mermaid.initialize({ startOnLoad: false, theme: isDark() ? "dark" : "neutral" });
  await mermaid.run({ nodes: diagrams });
}

document.addEventListener("DOMContentLoaded", () => {
  let wasDark = isDark();
  const drawIfChanged = () => {
    if (isDark() !== wasDark) {
      wasDark = isDark();
      draw();
    }
  };
  new MutationObserver(drawIfChanged).observe(document.body, { attributeFilter: ["data-theme"] });
  preference.addEventListener("change", drawIfChanged);
  draw();
});
