// Keeps the bulk runs that a page shows up to date. Elements with data-bulk hold parts with data-part.
import { listen } from "./events.js";
import { duration, element, json, moment, say, sentence, whileThere } from "./page.js";

const AT_WORK = ["LISTING", "RUNNING"];
const OPEN = [...AT_WORK, "PAUSED", "ERROR"];
const places = new Map([...document.querySelectorAll("[data-bulk]")].map((place) => [place.dataset.bulk, place]));
const one = document.getElementById("bulk");
const lost = document.getElementById("lost");
const newer = document.getElementById("newer");
const doneAtFirst = one === null ? 0 : Number(one.querySelector('[data-part="done"]').textContent);

let failedShown = one === null ? 0 : Number(one.querySelector('[data-part="failed"]').textContent);

function show(place, run) {
  const tell = (name, text) => {
    const part = place.querySelector(`[data-part="${name}"]`);
    if (part !== null && part.textContent !== text) part.textContent = text;
  };
  const phase = place.querySelector('[data-part="phase"]');
  const { total, failed } = run.images;
  const flawed = run.phase === "COMPLETED" && failed > 0;
  phase.className = `phase ${flawed ? "flawed" : run.phase}`;
  tell("phase", flawed ? `COMPLETED, ${failed} of ${total} failed` : run.phase);
  const counts = { ...run.images, total: run.listed ? total : `at least ${total}` };
  for (const [name, count] of Object.entries(counts)) tell(name, String(count));
  const pace = place === one || AT_WORK.includes(run.phase) ? run.images_an_hour : null;
  const unknown = place === one ? "unknown" : "";
  tell("pace", pace === null ? unknown : `${Number(pace.toPrecision(3))} images an hour`);
  if (!OPEN.includes(run.phase)) tell("left", place === one ? "none" : "");
  else tell("left", run.time_left_s === null ? unknown : duration(run.time_left_s));
  if (place === one) showOne(run);
}

/** Show the failures by reason. failed: their number. */
async function explain(failed) {
  failedShown = failed;
  const found = await json(`/bulk/${one.dataset.bulk}/reasons`);
  const rows = found.map(({ images, code, told }) =>
    element("tr", {}, element("td", { class: "number" }, images), element("td", {}, element("code", {}, code)), element("td", { class: "name" }, told)));
  document.querySelector("#reasons tbody").replaceChildren(...rows);
  document.getElementById("reasons").hidden = rows.length === 0;
}

function showOne(run) {
  const part = (name) => one.querySelector(`[data-part="${name}"]`);
  const { total, done, failed } = run.images;
  part("bar").max = total || 1;
  if (run.listed) part("bar").value = done + failed;
  else part("bar").removeAttribute("value"); // how much is left is not known
  part("error").hidden = run.error === null;
  part("error").textContent = run.error === null ? "" : sentence(run.error.message);
  part("ended").textContent = moment(run.ended_at);
  for (const change of one.querySelectorAll("[data-phases]")) {
    change.hidden = !change.dataset.phases.split(" ").includes(run.phase) || (change.hasAttribute("data-failed") && failed === 0);
  }
  if (failed !== failedShown) explain(failed);
  const more = done - doneAtFirst;
  newer.hidden = more <= 0;
  newer.firstElementChild.textContent = more === 1 ? "One more image is done." : `${more} more images are done.`;
}

/** A run was deleted, in this tab or elsewhere. */
function forget(id) {
  const place = places.get(id);
  places.delete(id);
  if (place !== one) return place.remove();
  for (const change of one.querySelectorAll("[data-phases]")) change.hidden = true;
  say(lost, "This run was deleted. Its products stay.");
}

/** Read again the runs whose events this page may have missed. */
async function look() {
  for (const [id, place] of places) {
    if (!OPEN.includes(place.querySelector('[data-part="phase"]').textContent)) continue;
    try {
      show(place, await json(`/v1/bulk/${id}`));
    } catch (error) {
      if (error.status === 404) forget(id);
      else if (error instanceof TypeError) return; // the stream tells when the service answers again
      else throw error;
    }
  }
}

for (const form of document.querySelectorAll("#bulk form")) whileThere(form, lost);
listen(({ name, data }) => {
  if (places.size === 0) return;
  if (name === "bulk" && places.has(data.id)) show(places.get(data.id), data);
  if (name === "gone" && data.kind === "bulk" && places.has(data.id)) forget(data.id);
  if (lost !== null && name === "lost") {
    lost.hidden = false;
    lost.textContent = "The service does not answer. When it is back, the run continues and this page updates itself.";
  }
  if (name === "found") {
    if (lost !== null) lost.hidden = true;
    look();
  }
});
look(); // a run may have changed since this page was made
