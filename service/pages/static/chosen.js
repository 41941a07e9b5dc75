// Sends a form with a file only in an open session: when a browser sends a form, it leaves the page and forgets the chosen file.
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
    // Other errors, such as a lost service, are shown by the next page or by the browser.
    request("/v1/jobs?limit=1").then(send, (error) => error.shown || send());
  });
}
