// Sends a file and shows how much has arrived, in the elements sending, sending-name, sending-done, sending-bar, stop and send.
import { forgetEndOfSession, request, say, serviceError, size, told } from "./page.js";

const BLOCK = 512;
const MOST_NAME = 100; // bytes
const REFUSALS = [400, 413, 415, 422]; // statuses that the same file gets again

const part = (name) => document.getElementById(name);

// The button sends a form without scripts; with them it sends again what did not arrive.
const again = part("send");
if (again !== null) again.hidden = true;

/** Send a file. said: the element for messages. Resolves with the description of what was uploaded; null: the service refused
 * the file; undefined: the file did not arrive, and can be sent again. */
export function send(file, name, address, type, said) {
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

// --- a tar archive (POSIX ustar) of files, which the browser reads while it sends ---

function octal(number, width) {
  return number.toString(8).padStart(width - 1, "0") + "\0";
}

/** The header block of a file. The same files always give the same bytes: no times, no owners. */
function header(name, size) {
  const text = new TextEncoder();
  const block = new Uint8Array(BLOCK);
  const put = (at, value) => block.set(typeof value === "string" ? text.encode(value) : value, at);
  const bytes = text.encode(name);
  if (bytes.length > MOST_NAME) throw new RangeError(`expected a file name of at most ${MOST_NAME} bytes; got ${name}: shorten it`);
  put(0, bytes);
  put(100, octal(0o644, 8));
  put(108, octal(0, 8));
  put(116, octal(0, 8));
  put(124, octal(size, 12));
  put(136, octal(0, 12));
  put(148, "        "); // the checksum is computed with spaces in its field
  put(156, "0");
  put(257, "ustar\0" + "00");
  put(148, octal(block.reduce((sum, byte) => sum + byte, 0), 7) + " ");
  return block;
}

/** The archive of files, by their names without folders. */
export function tar(files) {
  const parts = files.flatMap((file) => [header(file.name, file.size), file, new Uint8Array((BLOCK - (file.size % BLOCK)) % BLOCK)]);
  return new Blob([...parts, new Uint8Array(2 * BLOCK)]);
}
