// Checks a transit before it is sent: the name and size of an archive, or transit.json against the schema of the service and the chosen files.
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

const isA = {
  object: (value) => value !== null && typeof value === "object" && !Array.isArray(value),
  array: Array.isArray,
  string: (value) => typeof value === "string",
  number: (value) => typeof value === "number",
  integer: Number.isInteger,
  boolean: (value) => typeof value === "boolean",
  null: (value) => value === null,
};
// Keywords of JSON Schema that limit a value. Each function returns true, or a text that says what was expected.
const LIMITS = {
  const: (limit, value) => value === limit || `expected ${JSON.stringify(limit)}`,
  enum: (limit, value) => limit.includes(value) || `expected one of ${limit.join(", ")}`,
  minimum: (limit, value) => value >= limit || `expected at least ${limit}`,
  maximum: (limit, value) => value <= limit || `expected at most ${limit}`,
  exclusiveMinimum: (limit, value) => value > limit || `expected more than ${limit}`,
  minLength: (limit, value) => value.length >= limit || `expected at least ${limit} characters`,
  maxLength: (limit, value) => value.length <= limit || `expected at most ${limit} characters`,
  minItems: (limit, value) => value.length >= limit || `expected at least ${limit} entries`,
  maxItems: (limit, value) => value.length <= limit || `expected at most ${limit} entries`,
};

/** Compare a value with a JSON schema. found: {errors, unknown, files}; files are texts whose schema has the format file-name. */
export function compare(value, schema, root, path, found) {
  if (schema.$ref) return compare(value, root.$defs[schema.$ref.split("/").pop()], root, path, found);
  if (schema.anyOf) {
    const tries = schema.anyOf.map((one) => {
      const alone = { errors: [], unknown: [], files: [] };
      compare(value, one, root, path, alone);
      return alone;
    });
    const best = tries.find((one) => one.errors.length === 0) ?? tries[0];
    for (const name of Object.keys(found)) found[name].push(...best[name]);
    return;
  }
  const got = JSON.stringify(value)?.slice(0, 60);
  if (schema.type && !isA[schema.type](value)) {
    found.errors.push(`${path}: expected ${schema.type}; got ${got}`);
    return;
  }
  for (const [name, limit] of Object.entries(schema)) {
    const met = LIMITS[name]?.(limit, value) ?? true;
    if (met !== true) found.errors.push(`${path}: ${met}; got ${got}`);
  }
  if (schema.format === "file-name") found.files.push(value);
  if (schema.items) value.forEach((entry, place) => compare(entry, schema.items, root, `${path}[${place}]`, found));
  if (!schema.properties) return;
  const inside = (name) => (path === form.dataset.manifest ? name : `${path}.${name}`);
  for (const name of schema.required ?? []) if (!(name in value)) found.errors.push(`${inside(name)} is missing`);
  for (const [name, entry] of Object.entries(value)) {
    if (name in schema.properties) compare(entry, schema.properties[name], root, inside(name), found);
    else if (schema.additionalProperties === false) found.errors.push(`${inside(name)}: unknown field; remove it`);
    else found.unknown.push(`${inside(name)}: unknown field; the service ignores it`);
  }
}

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
  let content;
  try {
    content = JSON.parse(await manifest.text());
  } catch (error) {
    return say(said, `Expected JSON in ${manifest.name}; got: ${error.message}. Correct the file and choose it again.`, "error");
  }
  const found = { errors: [], unknown: [], files: [] };
  try {
    const schema = await json(form.dataset.schema);
    compare(content, schema, schema, form.dataset.manifest, found);
  } catch (error) {
    return say(said, told(error), "error");
  }
  if (files !== null) compareFiles(manifest, files, found);
  show(found.errors, found.unknown);
  const count = found.errors.length;
  if (count > 0) return say(said, `${manifest.name} has ${count} error${count === 1 ? "" : "s"}. Correct ${count === 1 ? "it" : "them"} and choose it again.`, "error");
  if (files === null) return say(said, `${manifest.name} is correct; it names ${counted(found.files.length)}. Choose the folder to check that they are there.`, "good");
  const whole = checked.reduce((sum, file) => sum + file.size, 0);
  sendFolder.hidden = false;
  say(said, `${manifest.name} is correct, and its ${counted(found.files.length)} ${found.files.length === 1 ? "is" : "are"} there (${size(whole)}). The names and sizes were checked. The service checks the content of the files after the upload.`, "good");
}

function counted(files) {
  return files === 1 ? "1 file" : `${files} files`;
}

/** Compare the names in transit.json with the chosen files; files that it does not name are not sent. */
function compareFiles(manifest, files, found) {
  const there = new Map(files.map((file) => [file.name, file]));
  for (const name of found.files) if (!there.has(name)) found.errors.push(`${name} is missing in the folder`);
  for (const name of found.files) if (there.get(name)?.size === 0) found.errors.push(`${name} is empty`);
  checked = [manifest, ...new Set(found.files.map((name) => there.get(name)).filter(Boolean))];
  const whole = checked.reduce((sum, file) => sum + file.size, 0);
  const most = Math.min(Number(form.dataset.most), Number(form.dataset.mostUnpacked));
  if (whole > most) found.errors.push(`expected at most ${size(most)}; the files have ${size(whole)}`);
  const extra = files.filter((file) => !checked.includes(file)).length;
  if (extra > 0) found.unknown.push(`${extra} file${extra === 1 ? "" : "s"} of the folder that ${manifest.name} does not name: not sent`);
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
