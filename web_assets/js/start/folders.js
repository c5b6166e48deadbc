/** Walks through the server's folders, also into recordings; what is a recording has a button. */

import { glyph, h } from "../dom.js";

/**
 * @param {{text: string, testid: string, onPick: (entry: object, button: HTMLButtonElement) => any}} options the button beside
 *     a recording; its test id goes on with the folder's name.
 * @returns {{nodes: Node[], show: (path: string) => Promise<void>}} what to put on the page, and the way to a folder; "" are
 *     the registered ones.
 */
export function createFolders(app, options) {
  const crumbs = h("nav", { class: "crumbs", "aria-label": "Folder" });
  const list = h("ul", { class: "folders", "data-testid": "folders", tabindex: -1 });

  async function show(path) {
    try {
      const listing = await app.api.get(`/api/folders?path=${encodeURIComponent(path)}`);
      crumbs.replaceChildren(...makeCrumbs(listing.path, show));
      list.replaceChildren(...(listing.entries.length ? listing.entries.map((entry) => makeEntry(entry, show, options)) : [nothing(listing.path)]));
      list.focus();
    } catch (error) {
      list.replaceChildren(h("li", { class: "error-box", role: "alert" }, error.message));
    }
  }

  return { nodes: [crumbs, list], show };
}

function nothing(path) {
  const text = path ? "Nothing in here." : "The server was told of no folder with recordings. Start it with --folder PATH, or put recordings where it may look.";
  return h("li", { class: "empty" }, text);
}

function makeCrumbs(path, show) {
  const parts = path ? path.split("/") : [];
  const step = (text, target) => h("button", { type: "button", class: "quiet", onclick: () => show(target) }, text);
  return [step("Folders", ""), ...parts.flatMap((part, i) => [h("span", { class: "muted" }, "/"), step(part, parts.slice(0, i + 1).join("/"))])];
}

function makeEntry(entry, show, { text, testid, onPick }) {
  const name = h("span", { class: "grow ellipsis", title: entry.name }, entry.name);
  const way_in = h("button", { type: "button", class: "quiet entry", onclick: () => show(entry.path), "data-testid": `folder-${entry.name}` }, glyph("folder"), name);
  if (entry.recording === null) return h("li", {}, way_in);
  const button = h("button", { type: "button", class: "primary", "data-testid": `${testid}-${entry.name}`, onclick: () => onPick(entry, button) }, text);
  return h("li", { class: "entry recording" }, entry.is_folder ? way_in : name, h("span", { class: "chip format" }, entry.recording), button);
}
