// Sends a form with a file only in an open session: the browser leaves the page by sending it, and forgets the file.
import { forgetEndOfSession, request } from "./page.js";

for (const form of document.querySelectorAll("form[enctype]")) {
  let asked = false;
  form.addEventListener("submit", (event) => {
    if (asked) {
      asked = false;
      return;
    }
    event.preventDefault();
    forgetEndOfSession();
    const send = () => {
      asked = true;
      form.requestSubmit(event.submitter);
    };
    // Other errors, such as a lost service, are told by the page that answers or by the browser.
    request("/v1/jobs?limit=1").then(send, (error) => error.shown || send());
  });
}
