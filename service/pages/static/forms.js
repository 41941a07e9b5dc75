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

/** Send a dropped or chosen image and show how much has arrived. Without this script the form itself sends the file. */
function sendImages(form) {
  const input = document.getElementById("file");
  const said = document.getElementById("upload-said");

  async function sendImage(file) {
    say(said, null);
    const reason = await refused(file, Number(form.dataset.most));
    if (reason !== null) return say(said, reason, "error");
    send(file, file.name, "/v1/images", "application/fits", said, (image) => location.assign(`/images/${image.id}`));
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (input.files.length > 0) sendImage(input.files[0]);
  });
  input.addEventListener("change", () => say(said, null));
  // A file that is dropped beside the form must not replace the page.
  for (const name of ["dragover", "drop"]) document.addEventListener(name, (event) => event.preventDefault());
  document.addEventListener("dragover", () => form.classList.add("over"));
  document.addEventListener("dragleave", () => form.classList.remove("over"));
  document.addEventListener("drop", (event) => {
    form.classList.remove("over");
    if (event.dataTransfer.files.length === 0) return;
    if (event.dataTransfer.files.length > 1) {
      say(said, `Expected one file; got ${event.dataTransfer.files.length}. Send many images with \`heliopsf deconvolve *.fits -o FOLDER/\`.`, "error");
      return;
    }
    input.files = event.dataTransfer.files;
    sendImage(event.dataTransfer.files[0]);
  });
}

/** Check the options of a deconvolution again whenever one of them changes. Without this script the form checks them when it is sent. */
function checkOptions(form) {
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
}

const upload = document.getElementById("upload");
const options = document.getElementById("start");
if (upload !== null) sendImages(upload);
else for (const form of document.querySelectorAll("form[enctype]")) sendInSession(form);
if (options !== null) checkOptions(options);
for (const place of document.querySelectorAll("[data-header]")) showHeader(place);
