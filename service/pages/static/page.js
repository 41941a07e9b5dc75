// Functions that the scripts of all pages share: elements, requests and their errors, texts, and the header of a file.

const MOST_ROWS = 2000;

/** An element. attributes: `on...` names add listeners, `class` and others are set as attributes; null ones are left out. */
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** An error that the service reported: `status`, `code` (its stable short name) and `fields` of the problem document. `shown`:
 * whether the page already says what to do. */
export class ServiceError extends Error {
  constructor(status, problem) {
    super(problem.detail || `the service answered ${status}`);
    this.status = status;
    this.code = (problem.type || "").replace("urn:heliopsf:", "");
    this.fields = problem;
    this.shown = false;
  }
}

/** An answer of the service. Throws `ServiceError`; a lost server is a TypeError of `fetch`. */
export async function request(address, options = {}) {
  const answer = await fetch(address, { credentials: "same-origin", ...options });
  if (answer.ok) return answer;
  throw await serviceError(answer.status, await answer.text());
}

/** The JSON of an answer. `body`: sent as JSON by POST. */
export async function json(address, body = undefined, options = {}) {
  const sent = body === undefined ? {} : { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  return (await request(address, { ...sent, ...options })).json();
}

/** The error of an answer with an error status. After the end of a session, the login page is opened. */
export function serviceError(status, text) {
  let problem = {};
  try {
    problem = JSON.parse(text);
  } catch {
    problem = { detail: text.slice(0, 500) };
  }
  const error = new ServiceError(status, problem);
  if (status === 401 && document.body.hasAttribute("data-keys")) {
    leadToLogin();
    error.shown = true;
  }
  return error;
}

/** Go to the login page, which then leads back to this page. If a file is chosen, stay on the page: the browser would forget the file. */
function leadToLogin() {
  const chosen = [...document.querySelectorAll("input[type=file]")].some((input) => input.files.length > 0);
  if (!chosen) return location.assign(`/login?ended=1&next=${encodeURIComponent(location.pathname + location.search)}`);
  forgetEndOfSession();
  const link = element("a", { href: "/login?ended=1", target: "_blank" }, "Log in in a new tab");
  const note = element("p", { id: "session-ended", class: "error", role: "alert" },
    "Your login has ended, and the service has not stored the file. ", link, ", come back to this tab and send the file. It is still chosen.");
  document.querySelector("main h1").after(note);
  note.scrollIntoView({ block: "nearest" });
}

/** Remove the note about the end of the session, before a new try. */
export function forgetEndOfSession() {
  document.getElementById("session-ended")?.remove();
}

/** The sentence that a page shows for an error. */
export function told(error) {
  if (error instanceof TypeError) return "The service does not answer. Nothing is lost: wait a moment, then try again.";
  return sentence(error.message);
}

/** A message of the service as a sentence for people: without what only commands and programs need. */
export function sentence(message) {
  const text = message.replace(/\s*\((?:--|psf_id\b)[^()]*\)|\s*\([^()]*(?:in a request|on the command line)[^()]*\)/g, "").trim();
  return text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
}

/** Send a form only while the service answers: otherwise the browser would leave the page for an error page of its own. */
export function whileThere(form, place) {
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await request("/v1/jobs?limit=1");
    } catch (error) {
      if (error.shown) return;
      if (error instanceof TypeError) return say(place, told(error));
    }
    form.submit();
  });
}

/** Show a message in an element that is announced; null hides it. */
export function say(place, text, kind = "note") {
  place.hidden = text === null;
  place.className = kind;
  place.textContent = text ?? "";
}

/** A time span, s, in words. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "unknown";
  if (seconds < 1) return "less than 1 s";
  if (seconds < 100) return `${Math.round(seconds)} s`;
  if (seconds < 6000) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

/** Date and time in UTC, as text; "-" for null. seconds: seconds since 1970. */
export function moment(seconds) {
  return seconds === null ? "-" : `${new Date(1000 * seconds).toISOString().slice(0, 19).replace("T", " ")} UTC`;
}

/** A number of bytes in words. */
export function size(count) {
  const units = ["B", "kB", "MB"];
  for (const unit of units) {
    if (count < 1000) return `${Number(count.toPrecision(3))} ${unit}`;
    count /= 1000;
  }
  return `${Number(count.toPrecision(3))} GB`;
}

/** Show the whole header of a file, with a search. place: an element with data-header, the address of the header as JSON. */
export async function showHeader(place) {
  const said = element("p", { role: "status", class: "soft" }, "Reading the header");
  place.replaceChildren(said);
  let hdus;
  try {
    const answer = await json(place.dataset.header);
    hdus = answer.hdus ?? answer;
  } catch (error) {
    say(said, told(error), "error");
    return;
  }
  const rows = hdus.flatMap((hdu) => hdu.cards.map((card) => [hdu.name || `HDU ${hdu.index}`, ...card]));
  const body = element("tbody");
  const search = element("input", { type: "search", id: "header-search", oninput: () => fill(search.value) });
  function fill(wanted) {
    const words = wanted.toLowerCase().split(/\s+/).filter(Boolean);
    const found = rows.filter((row) => words.every((word) => row.join(" ").toLowerCase().includes(word)));
    body.replaceChildren(
      ...found.slice(0, MOST_ROWS).map(([hdu, keyword, value, comment]) =>
        element("tr", {}, element("td", { class: "soft" }, hdu), element("th", { scope: "row" }, keyword), element("td", {}, String(value ?? "")), element("td", {}, comment ?? "")),
      ),
    );
    said.textContent = `${found.length} of ${rows.length} cards`;
  }
  const heads = ["HDU", "Keyword", "Value", "Comment"].map((head) => element("th", { scope: "col" }, head));
  place.replaceChildren(
    element("p", { class: "row" }, element("label", { for: "header-search" }, "Search the header"), search, said),
    element("div", { class: "scroll tall", tabindex: "0", role: "region", "aria-label": "Header" }, element("table", {}, element("thead", {}, element("tr", {}, ...heads)), body)),
  );
  fill("");
}
