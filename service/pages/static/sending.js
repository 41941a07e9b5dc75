// Sends a file and shows how much has arrived, in the elements sending, sending-name, sending-done, sending-bar and stop.
import { forgetEndOfSession, request, say, serviceError, size, told } from "./page.js";

const part = (name) => document.getElementById(name);

/** Send a file. said: the element for messages. arrived: called with the description of what was uploaded. */
export function send(file, name, address, type, said, arrived) {
  const sending = part("sending");
  const done = part("sending-done");
  const post = new XMLHttpRequest();
  const refused = (error) => error.shown || say(said, told(error), "error");
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
  post.onload = () => {
    sending.hidden = true;
    if (post.status < 300) arrived(JSON.parse(post.responseText));
    else refused(serviceError(post.status, post.responseText));
  };
  post.onerror = () => {
    sending.hidden = true;
    // If the service refuses a large file before its end, the connection ends, and the answer may be lost.
    request("/v1/jobs?limit=1").then(lost, (error) => error.shown || lost());
  };
  post.onabort = () => {
    sending.hidden = true;
    say(said, `The upload of ${name} was stopped. No part of it was stored.`, "note");
  };
  part("sending-name").textContent = name;
  part("stop").onclick = () => post.abort();
  sending.hidden = false;
  post.send(file);
}
