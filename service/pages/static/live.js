// Keeps the jobs and bulk runs that a page shows up to date. Elements with data-job or data-bulk hold parts with data-part.
import { duration, element, json, moment, request, say, sentence, told, whileThere } from "./page.js";

const ENDED = ["COMPLETED", "ERROR", "ABORTED"]; // phases of jobs
const AT_WORK = ["LISTING", "RUNNING"]; // phases of runs
const OPEN_RUN = [...AT_WORK, "PAUSED", "ERROR"];
const lost = document.getElementById("lost");

// --- events ---
// The events of all jobs and bulk runs of this owner. All tabs share one connection: a browser opens only six to one server, so with
// one stream for each tab, the seventh tab would stall. The tab that holds the lock reads the stream, and tells the others.

const PATIENCE_MS = 4000;
const AGAIN_MS = 3000;
const channel = new BroadcastChannel("heliopsf events");
const listeners = new Set();

/** Call listener({name, data}) for each event: "job" and "bulk" with their views, "gone", and "lost" or "found" for the connection. */
function listen(listener) {
  listeners.add(listener);
  if (listeners.size === 1) start();
}

function pass(event) {
  for (const listener of listeners) listener(event);
}

function start() {
  channel.onmessage = (message) => pass(message.data);
  if (navigator.locks) navigator.locks.request("heliopsf events", lead);
  else lead(); // an address that is neither https nor this machine has no locks
}

/** Read the stream until this tab is closed. */
function lead() {
  return new Promise(() => {
    let waiting = null;
    const tell = (event) => {
      pass(event);
      channel.postMessage(event);
    };
    const open = () => {
      const source = new EventSource("/v1/events");
      source.onopen = () => {
        // Events may have been missed before the stream began, so the pages read again what they show.
        tell({ name: "found", data: {} });
        clearTimeout(waiting);
        waiting = null;
      };
      for (const name of ["job", "bulk", "gone"]) {
        source.addEventListener(name, (event) => tell({ name, data: JSON.parse(event.data) }));
      }
      source.onerror = () => {
        // The service ends each stream after a set time. Therefore the end of a stream alone is not reported as lost.
        waiting ??= setTimeout(() => tell({ name: "lost", data: {} }), PATIENCE_MS);
        // The browser itself connects again after a lost connection, but not after an answer that is no stream.
        if (source.readyState === EventSource.CLOSED) setTimeout(again, AGAIN_MS);
      };
    };
    // After the end of a session this request leads to the login page; no other failure prevents a new try.
    const again = () => request("/v1/jobs?limit=1").then(open, open);
    open();
  });
}

// --- what a page shows ---

/**
 * Keep the elements of a kind ("job" or "bulk") up to date. address: of the things of this kind. isOpen(phase): whether the thing may
 * still change. ended: whether to follow also pages on which nothing is open. show(place, thing) shows it; forget(place) shows that it
 * was deleted, if it can be deleted.
 */
function keep({ kind, thing, address, isOpen, ended, show, forget }) {
  const places = new Map([...document.querySelectorAll(`[data-${kind}]`)].map((place) => [place.dataset[kind], place]));
  const phase = (place) => place.querySelector('[data-part="phase"]').textContent;
  const open = () => [...places].filter(([, place]) => isOpen(phase(place)));
  // An answer can arrive after a later event. Each event and request has a number, and only later numbers are shown.
  let number = 0;
  const shown = new Map();

  function showNewer(id, view, its) {
    if (!places.has(id) || its < (shown.get(id) ?? 0)) return;
    shown.set(id, its);
    show(places.get(id), view);
  }

  function drop(id) {
    if (!forget || !places.has(id)) return;
    forget(places.get(id));
    places.delete(id);
  }

  /** Read again the things whose events this page may have missed. */
  async function look() {
    for (const [id] of open()) {
      try {
        const its = ++number;
        showNewer(id, await json(`${address}/${id}`), its);
      } catch (error) {
        if (error.status === 404) drop(id);
        else if (error instanceof TypeError) return; // the stream tells when the service answers again
        else throw error;
      }
    }
  }

  for (const form of document.querySelectorAll(`#${kind} form`)) whileThere(form, lost);
  if (places.size === 0 || (!ended && open().length === 0)) return;
  listen(({ name, data }) => {
    if (name === kind) showNewer(data.id, data, ++number);
    if (name === "gone" && data.kind === kind) drop(data.id);
    if (lost !== null && name === "lost") {
      lost.hidden = false;
      lost.textContent = `The service does not answer. When it is back, the ${thing} continues and this page updates itself.`;
    }
    if (name === "found") {
      if (lost !== null) lost.hidden = true;
      look();
    }
  });
  look(); // a thing may have changed since this page was made
  return { look, phase };
}

// --- jobs ---

function progress(job) {
  if (job.phase === "QUEUED") return "waiting";
  if (job.error !== null) return sentence(job.error.message);
  if (job.phase !== "EXECUTING") return "";
  const { stage, step, steps, time_left_s: left } = job.progress;
  const pace = left === null ? "" : `, ${duration(left)} left`;
  return steps > 1 ? `${stage}, step ${step} of ${steps}${pace}` : `${stage}${pace}`;
}

function placeInQueue(before) {
  if (before === 0) return "This job starts next.";
  return before === 1 ? "1 job starts before this one." : `${before} jobs start before this one.`;
}

/** The page of a result at an address of the interface. */
function pageOf(result) {
  return result.replace(/^\/v1/, "");
}

function showJob(place, job) {
  const part = (name) => place.querySelector(`[data-part="${name}"]`);
  const phase = part("phase");
  phase.textContent = job.phase;
  phase.className = `phase ${job.phase}`;
  part("progress").textContent = place.id === "job" && job.error !== null ? "" : progress(job);
  if (place.id === "job") return showOneJob(place, part, job);
  if (job.result !== null) part("result").replaceChildren(element("a", { href: pageOf(job.result) }, "open"));
}

function showOneJob(place, part, job) {
  const bar = part("bar");
  const { step, steps, share } = job.progress;
  bar.max = share === null ? steps || 1 : 1;
  bar.value = share ?? step;
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
  part("result").href = pageOf(job.result);
  // Back must lead to the page before the job, not to a page that leads on at once.
  if (place.dataset.follow === "yes") location.replace(pageOf(job.result));
}

const theJob = document.getElementById("job");
const jobs = keep({ kind: "job", thing: "job", address: "/v1/jobs", isOpen: (phase) => !ENDED.includes(phase), ended: false, show: showJob });
// The place in the queue is not an event.
if (theJob !== null && jobs) setInterval(() => jobs.phase(theJob) === "QUEUED" && jobs.look(), 5000);

// --- bulk runs ---

const theRun = document.getElementById("bulk");
const newer = document.getElementById("newer");
const countOf = (name) => (theRun === null ? 0 : Number(theRun.querySelector(`[data-part="${name}"]`).textContent));
const doneAtFirst = countOf("done");
let failedShown = countOf("failed");

function showRun(place, run) {
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
  const pace = place === theRun || AT_WORK.includes(run.phase) ? run.images_an_hour : null;
  const unknown = place === theRun ? "unknown" : "";
  tell("pace", pace === null ? unknown : `${Number(pace.toPrecision(3))} images an hour`);
  if (!OPEN_RUN.includes(run.phase)) tell("left", place === theRun ? "none" : "");
  else tell("left", run.time_left_s === null ? unknown : duration(run.time_left_s));
  if (place === theRun) showOneRun(run);
}

/** Show the failures by reason. failed: their number. */
async function explain(failed) {
  failedShown = failed;
  const found = await json(`/bulk/${theRun.dataset.bulk}/reasons`);
  const rows = found.map(({ images, code, told }) =>
    element("tr", {}, element("td", { class: "number" }, images), element("td", {}, element("code", {}, code)), element("td", { class: "name" }, told)));
  document.querySelector("#reasons tbody").replaceChildren(...rows);
  document.getElementById("reasons").hidden = rows.length === 0;
}

function showOneRun(run) {
  const part = (name) => theRun.querySelector(`[data-part="${name}"]`);
  const { total, done, failed } = run.images;
  part("bar").max = total || 1;
  if (run.listed) part("bar").value = done + failed;
  else part("bar").removeAttribute("value"); // how much is left is not known
  part("error").hidden = run.error === null;
  part("error").textContent = run.error === null ? "" : sentence(run.error.message);
  part("ended").textContent = moment(run.ended_at);
  for (const change of theRun.querySelectorAll("[data-phases]")) {
    change.hidden = !change.dataset.phases.split(" ").includes(run.phase) || (change.hasAttribute("data-failed") && failed === 0);
  }
  if (failed !== failedShown) explain(failed);
  const more = done - doneAtFirst;
  newer.hidden = more <= 0;
  newer.firstElementChild.textContent = more === 1 ? "One more image is done." : `${more} more images are done.`;
}

function forgetRun(place) {
  if (place !== theRun) return place.remove();
  for (const change of theRun.querySelectorAll("[data-phases]")) change.hidden = true;
  say(lost, "This run was deleted. Its products stay.");
}

keep({ kind: "bulk", thing: "run", address: "/v1/bulk", isOpen: (phase) => OPEN_RUN.includes(phase), ended: true, show: showRun, forget: forgetRun });
