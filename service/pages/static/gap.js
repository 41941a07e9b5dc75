// Links the map of discs with the plot of their residuals: a slider, the map and the plot choose the same disc.
import { moveCursor, onCursor } from "./curves.js";

const place = document.getElementById("gap");
const figure = place.querySelector("[data-plot]");
const slider = document.getElementById("gap-disc");
const told = document.getElementById("gap-told");
const discs = new Map([...place.querySelectorAll("circle")].map((disc) => [Number(disc.dataset.row), disc]));

function choose(row) {
  for (const disc of place.querySelectorAll("circle.chosen")) disc.classList.remove("chosen");
  discs.get(row).classList.add("chosen");
  slider.value = row;
  told.textContent = discs.get(row).dataset.told;
}

document.getElementById("gap-choice").hidden = false;
slider.addEventListener("input", () => {
  choose(Number(slider.value));
  moveCursor(figure, Number(slider.value));
});
for (const [row, disc] of discs) {
  disc.addEventListener("pointerenter", () => {
    choose(row);
    moveCursor(figure, row);
  });
}
onCursor(figure, (row) => {
  if (row !== null) choose(row);
});
choose(0);
