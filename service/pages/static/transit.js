// Checks a transit before it is sent: the name and size of an archive, or transit.json, by the service, and the chosen files.
import { element, json, say, size, told } from "./page.js";
import { send, tar } from "./sending.js";

const form = document.getElementById("upload");
const archive = document.getElementById("file");
const folder = document.getElementById("folder");
const said = document.getElementById("upload-said");
const list = document.getElementById("found");
const ARCHIVE = /\.(zip|tar|tar\.gz|tgz)$/i;
const MOST_SHOWN = 20;

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
