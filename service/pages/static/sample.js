// The sample image on the first page: the picture after the deconvolution lies on the one before, and a slider divides them.
// Without this script the two pictures stand side by side.

import { element } from "./page.js";

const halves = document.querySelector("#sample .halves");
const after = halves.lastElementChild;
const divider = element("input", { type: "range", class: "wide", min: 0, max: 100, value: 50, "aria-label": "Divider between before and after" });

function divide() {
  after.style.clipPath = `inset(0 0 0 ${divider.value}%)`;
  halves.style.setProperty("--divider", `${divider.value}%`);
}

function follow(event) {
  const box = halves.getBoundingClientRect();
  divider.value = (100 * (event.clientX - box.left)) / box.width;
  divide();
}

divider.addEventListener("input", divide);
halves.addEventListener("pointerdown", (event) => {
  event.preventDefault(); // otherwise the browser would drag the picture
  halves.setPointerCapture(event.pointerId);
  follow(event);
});
halves.addEventListener("pointermove", (event) => {
  if (halves.hasPointerCapture(event.pointerId)) follow(event);
});
halves.classList.add("divided");
halves.after(divider);
divide();
