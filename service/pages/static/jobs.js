// Keeps the jobs that a page shows up to date. Elements with data-job hold parts with data-part.
import { listen } from "./events.js";
import { duration, element, json, moment, sentence, whileThere } from "./page.js";

const ENDED = ["COMPLETED", "ERROR", "ABORTED"];

function progress(job) {
  if (job.phase === "QUEUED") return "waiting";
  if (job.error !== null) return sentence(job.error.message);
  if (job.phase !== "EXECUTING") return "";
  const { stage, step, steps, time_left_s: left } = job.progress;
  const pace = left === null ? "" : `, ${duration(left)} left`;
  return steps > 0 ? `${stage} ${step} of ${steps}${pace}` : stage;
}

function placeInQueue(before) {
  if (before === 0) return "This job starts next.";
  return before === 1 ? "1 job starts before this one." : `${before} jobs start before this one.`;
}

/** The page of a result at an address of the interface. */
export function pageOf(result) {
  return result.replace(/^\/v1/, "");
}

/** The page that follows a job: that of its result, or that of the image for which a PSF was built. */
function nextPage(place, job) {
  const image = place.dataset.image;
  return image ? `/images/${image}?psf_id=${job.result.split("/").pop()}` : pageOf(job.result);
}

function show(place, job) {
  const part = (name) => place.querySelector(`[data-part="${name}"]`);
  const phase = part("phase");
  phase.textContent = job.phase;
  phase.className = `phase ${job.phase}`;
  part("progress").textContent = place.id === "job" && job.error !== null ? "" : progress(job);
  if (place.id === "job") return showOne(place, part, job);
  if (job.result !== null) part("result").replaceChildren(element("a", { href: pageOf(job.result) }, "open"));
}

function showOne(place, part, job) {
  const bar = part("bar");
  bar.max = job.progress.steps || 1;
  bar.value = job.progress.step;
  bar.hidden = ENDED.includes(job.phase);
  const waiting = part("place");
  waiting.hidden = job.phase !== "QUEUED";
  if (typeof job.waiting_before === "number") waiting.textContent = placeInQueue(job.waiting_before);
  const error = part("error");
  error.hidden = job.error === null;
  error.textContent = job.error === null ? "" : sentence(job.error.message);
  const again = part("again");
  if (again) again.hidden = !["ERROR", "ABORTED"].includes(job.phase);
  part("started").textContent = moment(job.started_at);
  part("ended").textContent = moment(job.ended_at);
  part("attempts").textContent = job.attempt;
  if (!ENDED.includes(job.phase)) return;
  const cancel = part("cancel");
  if (cancel) cancel.hidden = true;
  part("done").hidden = job.result === null;
  if (job.result === null) return;
  part("result").href = nextPage(place, job);
  // Back must lead to the page before the job, not to a page that leads on at once.
  if (place.dataset.follow === "yes") location.replace(nextPage(place, job));
}

const places = new Map([...document.querySelectorAll("[data-job]")].map((place) => [place.dataset.job, place]));
const one = document.getElementById("job");
const lost = document.getElementById("lost");
const shown = (id) => places.get(id).querySelector('[data-part="phase"]').textContent;
const open = () => [...places.keys()].filter((id) => !ENDED.includes(shown(id)));

/** Read again the jobs whose events this page may have missed. */
async function look() {
  for (const id of open()) {
    try {
      show(places.get(id), await json(`/v1/jobs/${id}`));
    } catch (error) {
      if (!(error instanceof TypeError)) throw error;
      return; // the stream tells when the service answers again
    }
  }
}

const cancel = document.querySelector("[data-part=cancel]");
if (cancel !== null) whileThere(cancel, lost);
if (open().length > 0) {
  listen(({ name, data }) => {
    if (name === "job" && places.has(data.id)) show(places.get(data.id), data);
    if (lost !== null && name === "lost") {
      lost.hidden = false;
      lost.textContent = "The service does not answer. When it is back, the job continues and this page updates itself.";
    }
    if (name === "found") {
      if (lost !== null) lost.hidden = true;
      look();
    }
  });
  look(); // a job may have changed since this page was made
  // The place in the queue is not an event.
  if (one !== null) setInterval(() => shown(one.dataset.job) === "QUEUED" && look(), 5000);
}
