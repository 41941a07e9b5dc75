// Sends a dropped or chosen file and shows how much has arrived. Without this script the form itself sends the file.
import { say, size } from "./page.js";
import { send } from "./sending.js";

const form = document.getElementById("upload");
const input = document.getElementById("file");
const said = document.getElementById("upload-said");

/** Why a file cannot be an image, from its first bytes and its size; null if it can. */
export async function refused(file, most) {
  if (file.size > most) return `Expected a file of at most ${size(most)}; ${file.name} has ${size(file.size)}.`;
  const start = new Uint8Array(await file.slice(0, 9).arrayBuffer());
  const zipped = start[0] === 0x1f && start[1] === 0x8b;
  const text = String.fromCharCode(...start);
  if (file.size === 0) return `${file.name} is empty. Choose another file.`;
  if (!zipped && text !== "SIMPLE  =") return `${file.name} is not a FITS file: a FITS file begins with SIMPLE. Choose another file.`;
  return null;
}

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
