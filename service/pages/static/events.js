// The events of all jobs and bulk runs of this owner. All tabs share one connection: a browser opens only six to one
// server, so with one stream for each tab, the seventh tab would stall. The tab that holds the lock reads the stream, and tells the others.

import { request } from "./page.js";

const PATIENCE_MS = 4000;
const AGAIN_MS = 3000;
const channel = new BroadcastChannel("heliopsf events");
const listeners = new Set();

/** Call listener({name, data}) for each event: "job" and "bulk" with their views, "gone", and "lost" or "found" for the connection. */
export function listen(listener) {
  listeners.add(listener);
  if (listeners.size === 1) start();
}

function pass(event) {
  for (const listener of listeners) listener(event);
}

function start() {
  channel.onmessage = (message) => pass(message.data);
  if (navigator.locks) navigator.locks.request("heliopsf events", lead);
  else lead(); // an address that is neither https nor this machine has no locks
}

/** Read the stream until this tab is closed. */
function lead() {
  return new Promise(() => {
    let waiting = null;
    const tell = (event) => {
      pass(event);
      channel.postMessage(event);
    };
    const open = () => {
      const source = new EventSource("/v1/events");
      source.onopen = () => {
        // Events may have been missed in the meantime, so the pages read again what they show.
        if (waiting !== null) tell({ name: "found", data: {} });
        clearTimeout(waiting);
        waiting = null;
      };
      for (const name of ["job", "bulk", "gone"]) {
        source.addEventListener(name, (event) => tell({ name, data: JSON.parse(event.data) }));
      }
      source.onerror = () => {
        // The service ends each stream after a set time. Therefore the end of a stream alone is not reported as lost.
        waiting ??= setTimeout(() => tell({ name: "lost", data: {} }), PATIENCE_MS);
        // The browser itself connects again after a lost connection, but not after an answer that is no stream.
        if (source.readyState === EventSource.CLOSED) setTimeout(again, AGAIN_MS);
      };
    };
    // After the end of a session this request leads to the login page; no other failure prevents a new try.
    const again = () => request("/v1/jobs?limit=1").then(open, open);
    open();
  });
}
