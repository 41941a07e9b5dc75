// Checks a transit before it is sent: the name and size of an archive, or transit.json, by the service, and the chosen files.
import { element, json, say, size, told } from "./page.js";
import { send, tar } from "./sending.js";

const form = document.getElementById("upload");
const archive = document.getElementById("file");
const folder = document.getElementById("folder");
const loose = document.getElementById("loose");
const said = document.getElementById("upload-said");
const list = document.getElementById("found");
const sendFolder = document.getElementById("send-folder");
const ARCHIVE = /\.(zip|tar|tar\.gz|tgz)$/i;
const MOST_SHOWN = 20;
let checked = []; // the files of the folder that passed the check

/** Show what a check found: errors, then notes. */
function show(errors, notes) {
  const shown = [...errors.map((text) => [text, "bad"]), ...notes.map((text) => [text, "soft"])];
  const more = shown.length > MOST_SHOWN ? [element("li", {}, `and ${shown.length - MOST_SHOWN} more`)] : [];
  list.replaceChildren(...shown.slice(0, MOST_SHOWN).map(([text, kind]) => element("li", { class: kind }, text)), ...more);
  list.hidden = shown.length === 0;
}

/** Check a transit.json; files: the other files of the folder, or null if only transit.json was chosen. */
async function check(manifest, files) {
  sendFolder.hidden = true;
  show([], []);
  let names;
  try {
    names = await json("/transits/check", undefined, { method: "POST", body: await compact(manifest) });
  } catch (error) {
    return say(said, `${told(error)} Correct the file and choose it again.`, "error");
  }
  if (files === null) return say(said, `${manifest.name} is correct; it names ${counted(names.length)}. Choose the folder to check that they are there.`, "good");
  const [errors, notes] = compareFiles(manifest, files, names);
  show(errors, notes);
  if (errors.length > 0) return say(said, "Correct the folder and choose it again.", "error");
  const whole = checked.reduce((sum, file) => sum + file.size, 0);
  sendFolder.hidden = false;
  say(said, `${manifest.name} is correct, and its ${counted(names.length)} ${names.length === 1 ? "is" : "are"} there (${size(whole)}). The names and sizes were checked. The service checks the content of the files after the upload.`, "good");
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

function counted(files) {
  return files === 1 ? "1 file" : `${files} files`;
}

/** Compare the names in transit.json with the chosen files: errors and notes. Files that it does not name are not sent. */
function compareFiles(manifest, files, names) {
  const there = new Map(files.map((file) => [file.name, file]));
  const errors = names.filter((name) => !there.has(name)).map((name) => `${name} is missing in the folder`);
  errors.push(...names.filter((name) => there.get(name)?.size === 0).map((name) => `${name} is empty`));
  checked = [manifest, ...new Set(names.map((name) => there.get(name)).filter(Boolean))];
  const whole = checked.reduce((sum, file) => sum + file.size, 0);
  const most = Math.min(Number(form.dataset.most), Number(form.dataset.mostUnpacked));
  if (whole > most) errors.push(`expected at most ${size(most)}; the files have ${size(whole)}`);
  const extra = files.filter((file) => !checked.includes(file)).length;
  return [errors, extra > 0 ? [`${extra} file${extra === 1 ? "" : "s"} of the folder that ${manifest.name} does not name: not sent`] : []];
}

async function go(file, name) {
  const transit = await send(file, name, "/v1/transits", "application/octet-stream", said);
  if (transit) location.assign(`/transits/${transit.id}`);
}

function goArchive() {
  const file = archive.files[0];
  say(said, null);
  show([], []);
  sendFolder.hidden = true;
  if (!file) return;
  const most = Number(form.dataset.most);
  if (!ARCHIVE.test(file.name)) say(said, `Expected an archive (.zip, .tar, .tar.gz); got ${file.name}. Choose another file, or choose the folder.`, "error");
  else if (file.size > most) say(said, `Expected at most ${size(most)}; ${file.name} has ${size(file.size)}.`, "error");
  else go(file, file.name);
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  goArchive();
});
archive.addEventListener("change", goArchive);
loose.addEventListener("change", () => {
  if (loose.files[0]) check(loose.files[0], null);
});
folder.addEventListener("change", () => {
  // A browser also lists the files of subfolders; a transit is one folder without subfolders.
  const files = [...folder.files].filter((file) => file.webkitRelativePath.split("/").length <= 2);
  const manifest = files.find((file) => file.name === form.dataset.manifest);
  show([], []);
  sendFolder.hidden = true;
  if (manifest) check(manifest, files.filter((file) => file !== manifest));
  else if (files.length > 0) say(said, `Expected a file ${form.dataset.manifest} in the folder; it has none. Add it, and choose the folder again.`, "error");
});
sendFolder.addEventListener("click", () => {
  const name = folder.files[0].webkitRelativePath.split("/")[0] || "transit";
  go(tar(checked), `${name}.tar`);
});
document.getElementById("folder-part").hidden = false;
