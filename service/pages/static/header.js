// The whole header of a file, with a search. The place is an element with data-header: the address of the header as JSON.
import { element, json, say, told } from "./page.js";

const MOST_ROWS = 2000;

/** Show the header in its place. */
export async function showHeader(place) {
  const said = element("p", { role: "status", class: "soft" }, "Reading the header");
  place.replaceChildren(said);
  let hdus;
  try {
    const answer = await json(place.dataset.header);
    hdus = answer.hdus ?? answer;
  } catch (error) {
    say(said, told(error), "error");
    return;
  }
  const rows = hdus.flatMap((hdu) => hdu.cards.map((card) => [hdu.name || `HDU ${hdu.index}`, ...card]));
  const body = element("tbody");
  const search = element("input", { type: "search", id: "header-search", oninput: () => fill(search.value) });
  function fill(wanted) {
    const words = wanted.toLowerCase().split(/\s+/).filter(Boolean);
    const found = rows.filter((row) => words.every((word) => row.join(" ").toLowerCase().includes(word)));
    body.replaceChildren(
      ...found.slice(0, MOST_ROWS).map(([hdu, keyword, value, comment]) =>
        element("tr", {}, element("td", { class: "soft" }, hdu), element("th", { scope: "row" }, keyword), element("td", {}, String(value ?? "")), element("td", {}, comment ?? "")),
      ),
    );
    said.textContent = `${found.length} of ${rows.length} cards`;
  }
  const heads = ["HDU", "Keyword", "Value", "Comment"].map((head) => element("th", { scope: "col" }, head));
  place.replaceChildren(
    element("p", { class: "row" }, element("label", { for: "header-search" }, "Search the header"), search, said),
    element("div", { class: "scroll tall", tabindex: "0", role: "region", "aria-label": "Header" }, element("table", {}, element("thead", {}, element("tr", {}, ...heads)), body)),
  );
  fill("");
}

for (const place of document.querySelectorAll("[data-header]")) showHeader(place);
