// The forms of the pages: an image that is sent, the options of a deconvolution, and a PSF that is sent.
import { element, forgetEndOfSession, json, request, say, showHeader, size, told } from "./page.js";
import { send } from "./sending.js";

/** Why a file cannot be an image, from its first bytes and its size; null if it can. */
async function refused(file, most) {
  if (file.size > most) return `Expected a file of at most ${size(most)}; ${file.name} has ${size(file.size)}.`;
  const start = new Uint8Array(await file.slice(0, 9).arrayBuffer());
  const zipped = start[0] === 0x1f && start[1] === 0x8b;
  const text = String.fromCharCode(...start);
  if (file.size === 0) return `${file.name} is empty. Choose another file.`;
  if (!zipped && text !== "SIMPLE  =") return `${file.name} is not a FITS file: a FITS file begins with SIMPLE. Choose another file.`;
  return null;
}

/**
 * Send dropped or chosen images, one after the other. One image alone leads to its page; several are deconvolved, if they need no
 * option. Without this script the form sends one file.
 */
function sendImages(form) {
  const input = document.getElementById("file");
  const list = document.getElementById("files");
  const waiting = []; // {file, line}
  let busy = false;
  input.multiple = true;

  /** Send these files after those that are being sent. What was refused or stopped gives way to them. */
  function take(files) {
    for (const line of list.querySelectorAll(".error, .note")) line.remove();
    if (!busy) for (const { line } of waiting.splice(0)) line.remove();
    for (const file of files) {
      const line = element("li", {}, `${file.name}: waiting`);
      list.append(line);
      waiting.push({ file, line });
    }
    sendAll();
  }

  async function sendAll() {
    if (busy) return;
    busy = true;
    while (waiting.length > 0) {
      const { file, line } = waiting[0];
      const reason = await refused(file, Number(form.dataset.most));
      if (reason !== null) say(line, reason, "error");
      const image = reason === null ? await send(file, file.name, "/v1/images", "application/fits", line) : null;
      if (image === undefined) break;
      waiting.shift();
      if (image === null) continue;
      if (list.children.length === 1) {
        busy = false; // for whoever comes back
        list.replaceChildren();
        return location.assign(`/images/${image.id}`);
      }
      line.replaceChildren(element("a", { href: `/images/${image.id}` }, file.name), ": ", await begun(image.id));
    }
    busy = false;
    if (waiting.length === 0) input.value = ""; // the same name can be chosen again
  }

  /** Start the deconvolution of an image. Returns a link to its job, or the reason why it needs an option. */
  async function begun(id) {
    try {
      const { good, lines } = await json(`/images/${id}/check`);
      if (!good) return lines[0].split(/(?<=\.) /)[0]; // its page says the rest
      const job = await json("/v1/jobs", { kind: "deconvolve", parameters: { image_id: id } });
      return element("a", { href: `/jobs/${job.id}` }, "started");
    } catch (error) {
      return told(error);
    }
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    sendAll();
  });
  input.addEventListener("change", () => take(input.files));
  // A file that is dropped beside the form must not replace the page.
  for (const name of ["dragover", "drop"]) document.addEventListener(name, (event) => event.preventDefault());
  document.addEventListener("dragover", () => form.classList.add("over"));
  document.addEventListener("dragleave", () => form.classList.remove("over"));
  document.addEventListener("drop", (event) => {
    form.classList.remove("over");
    if (event.dataTransfer.files.length === 0) return;
    input.files = event.dataTransfer.files;
    take(input.files);
  });
}

/** Check the options of a deconvolution again whenever one of them changes. Without this script the form checks them when it is sent. */
function checkOptions(form) {
  const place = document.getElementById("checked");
  const ways = document.getElementById("ways");
  const button = document.getElementById("go");
  const others = document.getElementById("others");
  let last = 0;

  function show(good, lines) {
    place.className = good ? "good" : "error";
    place.replaceChildren(...lines.map((line) => element("p", {}, line)));
    button.disabled = !good;
  }

  /** Let the service check the options. If several checks are open, only the answer to the last one is shown. */
  async function check() {
    const mine = ++last;
    const options = new URLSearchParams(new FormData(form));
    options.delete("form_token");
    button.textContent = "Check and start";
    button.disabled = false;
    if (others !== null) others.disabled = !form.elements.other_channel.checked;
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

  button.disabled = place.className === "error";
  form.addEventListener("change", check);
  // A browser that comes back to this page shows the options as they were left.
  window.addEventListener("pageshow", (event) => event.persisted && check());
}

/** Send a form with a file only in an open session: when a browser sends a form, it leaves the page and forgets the chosen file. */
function sendInSession(form) {
  let asked = false;
  form.addEventListener("submit", (event) => {
    if (asked) {
      asked = false;
      return;
    }
    event.preventDefault();
    forgetEndOfSession();
    const goOn = () => {
      asked = true;
      form.requestSubmit(event.submitter);
    };
    // Other errors, such as a lost service, are shown by the next page or by the browser.
    request("/v1/jobs?limit=1").then(goOn, (error) => error.shown || goOn());
  });
  if (form.hasAttribute("data-now")) form.addEventListener("change", () => form.requestSubmit());
}

const upload = document.getElementById("upload");
const options = document.getElementById("start");
if (upload !== null) sendImages(upload);
else for (const form of document.querySelectorAll("form[enctype]")) sendInSession(form);
if (options !== null) checkOptions(options);
for (const place of document.querySelectorAll("[data-header]")) showHeader(place);
