// Checks the options of a deconvolution again whenever one of them changes. Without this script the form checks them when it is sent.
import { element, json, told } from "./page.js";

const form = document.getElementById("start");
const place = document.getElementById("checked");
const ways = document.getElementById("ways");
const button = document.getElementById("go");
let last = 0;

function show(good, lines) {
  place.className = good ? "good" : "error";
  place.replaceChildren(...lines.map((line) => element("p", {}, line)));
}

/** Let the service check the options. If several checks are open, only the answer to the last one is shown. */
async function check() {
  const mine = ++last;
  const options = new URLSearchParams(new FormData(form));
  options.delete("form_token");
  button.textContent = "Check and start";
  try {
    const found = await json(`${form.dataset.check}?${options}`);
    if (mine !== last) return;
    show(found.good, found.lines);
    button.textContent = found.button;
    if (ways !== null) ways.hidden = found.code !== ways.dataset.code;
  } catch (error) {
    if (mine === last && !error.shown) show(false, [told(error)]);
  }
}

form.addEventListener("change", check);
// A browser that comes back to this page shows the options as they were left.
window.addEventListener("pageshow", (event) => event.persisted && check());
