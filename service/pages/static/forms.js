// The forms of the pages: an image or a transit that is sent, the options of a deconvolution, and a PSF that is sent.
import { element, forgetEndOfSession, json, request, say, serviceError, showHeader, size, told } from "./page.js";

const REFUSALS = [400, 413, 415, 422]; // statuses that the same file gets again
const ARCHIVE = /\.(zip|tar|tar\.gz|tgz)$/i;
const MOST_SHOWN = 20; // errors of a folder
const BLOCK = 512; // bytes of a block of a tar archive
const MOST_NAME = 100; // bytes of a name in it

// --- a file on its way ---
// Shows how much has arrived, in the elements sending, sending-name, sending-done, sending-bar, stop and send.

const part = (name) => document.getElementById(name);

// The button sends a form without scripts; with them it sends again what did not arrive.
const again = part("send");
if (again !== null) again.hidden = true;

/** Send a file. said: the element for messages. Resolves with the description of what was uploaded; null: the service refused
 * the file; undefined: the file did not arrive, and can be sent again. */
function send(file, name, address, type, said) {
  const sending = part("sending");
  const done = part("sending-done");
  const post = new XMLHttpRequest();
  const lost = () => say(said, `The connection to the service ended before all of ${name} had arrived. No part of it was stored. The file is still chosen: send it again.`, "error");
  forgetEndOfSession();
  post.open("POST", `${address}?filename=${encodeURIComponent(name)}`);
  post.setRequestHeader("Content-Type", type);
  post.upload.onprogress = (event) => {
    part("sending-bar").max = event.total || file.size;
    part("sending-bar").value = event.loaded;
    done.textContent = `${size(event.loaded)} of ${size(file.size)}`;
  };
  post.upload.onload = () => {
    done.textContent = "received; the service reads it";
  };
  part("sending-name").textContent = name;
  part("stop").onclick = () => post.abort();
  sending.hidden = false;
  again.hidden = true;
  return new Promise((resolve) => {
    const end = (stored) => {
      sending.hidden = true;
      again.hidden = stored !== undefined;
      resolve(stored);
    };
    const refuse = (error) => {
      if (!error.shown) say(said, told(error), "error");
      end(REFUSALS.includes(error.status) ? null : undefined);
    };
    post.onload = () => (post.status < 300 ? end(JSON.parse(post.responseText)) : refuse(serviceError(post.status, post.responseText)));
    post.onerror = () => {
      // If the service refuses a large file before its end, the connection ends, and the answer may be lost.
      request("/v1/jobs?limit=1").then(lost, (error) => error.shown || lost()).then(() => end(undefined));
    };
    post.onabort = () => {
      say(said, `The upload of ${name} was stopped. No part of it was stored.`, "note");
      end(undefined);
    };
    post.send(file);
  });
}

// --- images ---

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

// --- a transit ---

/** Check a transit before it is sent: the name and size of an archive, or transit.json, by the service, and the chosen files. */
function sendTransit(form) {
  const archive = document.getElementById("file");
  const folder = document.getElementById("folder");
  const said = document.getElementById("upload-said");
  const list = document.getElementById("found");

  /** Show the errors that a check found. */
  function show(errors) {
    const more = errors.length > MOST_SHOWN ? [element("li", {}, `and ${errors.length - MOST_SHOWN} more`)] : [];
    list.replaceChildren(...errors.slice(0, MOST_SHOWN).map((text) => element("li", { class: "bad" }, text)), ...more);
    list.hidden = errors.length === 0;
  }

  /** Check a transit.json and the other files of its folder, and send them. */
  async function sendFolder(manifest, files) {
    let names;
    try {
      names = await json("/transits/check", undefined, { method: "POST", body: await compact(manifest) });
    } catch (error) {
      return say(said, `${told(error)} Correct the file and choose the folder again.`, "error");
    }
    const [sent, errors] = compareFiles(manifest, files, names);
    show(errors);
    if (errors.length > 0) return say(said, "Correct the folder and choose it again.", "error");
    go(tar(sent), `${folder.files[0].webkitRelativePath.split("/")[0] || "transit"}.tar`);
  }

  /** The text of a transit.json without the white space that JSON does not need. */
  async function compact(manifest) {
    const text = await manifest.text();
    try {
      return JSON.stringify(JSON.parse(text));
    } catch {
      return text; // the service says where it is no JSON
    }
  }

  /** Compare the names in transit.json with the chosen files: the files to send (no others), and errors. */
  function compareFiles(manifest, files, names) {
    const there = new Map(files.map((file) => [file.name, file]));
    const errors = names.filter((name) => !there.has(name)).map((name) => `${name} is missing in the folder`);
    errors.push(...names.filter((name) => there.get(name)?.size === 0).map((name) => `${name} is empty`));
    const sent = [manifest, ...new Set(names.map((name) => there.get(name)).filter(Boolean))];
    const whole = sent.reduce((sum, file) => sum + file.size, 0);
    const most = Math.min(Number(form.dataset.most), Number(form.dataset.mostUnpacked));
    if (whole > most) errors.push(`expected at most ${size(most)}; the files have ${size(whole)}`);
    return [sent, errors];
  }

  async function go(file, name) {
    const transit = await send(file, name, "/v1/transits", "application/octet-stream", said);
    if (transit) location.assign(`/transits/${transit.id}`);
  }

  /** Send what one of the two inputs holds. */
  function goOn(input, other) {
    other.value = "";
    say(said, null);
    show([]);
    const [file] = input.files;
    if (!file) return;
    if (input === folder) return goFolder();
    const most = Number(form.dataset.most);
    if (!ARCHIVE.test(file.name)) say(said, `Expected an archive (.zip, .tar, .tar.gz); got ${file.name}. Choose another file, or choose the folder.`, "error");
    else if (file.size > most) say(said, `Expected at most ${size(most)}; ${file.name} has ${size(file.size)}.`, "error");
    else go(file, file.name);
  }

  function goFolder() {
    // A browser also lists the files of subfolders; a transit is one folder without subfolders.
    const files = [...folder.files].filter((file) => file.webkitRelativePath.split("/").length <= 2);
    const manifest = files.find((file) => file.name === form.dataset.manifest);
    if (manifest) sendFolder(manifest, files.filter((file) => file !== manifest));
    else say(said, `Expected a file ${form.dataset.manifest} in the folder; it has none. Add it, and choose the folder again.`, "error");
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (folder.files.length > 0) goOn(folder, archive);
    else goOn(archive, folder);
  });
  archive.addEventListener("change", () => goOn(archive, folder));
  folder.addEventListener("change", () => goOn(folder, archive));
  document.getElementById("folder-part").hidden = false;
}

// --- a tar archive (POSIX ustar) of files, which the browser reads while it sends ---

function octal(number, width) {
  return number.toString(8).padStart(width - 1, "0") + "\0";
}

/** The header block of a file. The same files always give the same bytes: no times, no owners. */
function tarHeader(name, bytes) {
  const text = new TextEncoder();
  const block = new Uint8Array(BLOCK);
  const put = (at, value) => block.set(typeof value === "string" ? text.encode(value) : value, at);
  const path = text.encode(name);
  if (path.length > MOST_NAME) throw new RangeError(`expected a file name of at most ${MOST_NAME} bytes; got ${name}: shorten it`);
  put(0, path);
  put(100, octal(0o644, 8));
  put(108, octal(0, 8));
  put(116, octal(0, 8));
  put(124, octal(bytes, 12));
  put(136, octal(0, 12));
  put(148, "        "); // the checksum is computed with spaces in its field
  put(156, "0");
  put(257, "ustar\0" + "00");
  put(148, octal(block.reduce((sum, byte) => sum + byte, 0), 7) + " ");
  return block;
}

/** The archive of files, by their names without folders. */
function tar(files) {
  const parts = files.flatMap((file) => [tarHeader(file.name, file.size), file, new Uint8Array((BLOCK - (file.size % BLOCK)) % BLOCK)]);
  return new Blob([...parts, new Uint8Array(2 * BLOCK)]);
}

// --- other forms ---

/** Check the options of a deconvolution againwhenever one of them changes. Without this script the form checks them when it is sent. */
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
if (upload === null) for (const form of document.querySelectorAll("form[enctype]")) sendInSession(form);
else if ("manifest" in upload.dataset) sendTransit(upload);
else sendImages(upload);
if (options !== null) checkOptions(options);
for (const place of document.querySelectorAll("[data-header]")) showHeader(place);
