// Draws all diagrams of a page, in the colours that the reader has chosen, and again when these change.
"use strict";

const SMALLEST = 1.6; // times smaller than drawn
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
  // They are made to fit; those that nobody could read then are scrolled instead.
  for (const svg of document.querySelectorAll("pre.mermaid svg")) {
    svg.style.minWidth = `${svg.viewBox.baseVal.width / SMALLEST}px`;
  }
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
