/** A browser of the server's folders, including those inside recordings. Recordings have a button. */

import { glyph, h } from "../dom.js";
import { messageOf } from "../errors.js";

/**
 * @param {App} app
 * @param {Picker} options
 * @returns {{nodes: Node[], show: (path: string) => Promise<void>}} the elements, and the function that
 *     opens a folder; "" lists the server's folders.
 */
export function createFolders(app, options) {
  const crumbs = h("nav", { class: "crumbs", "aria-label": "Folder" });
  const list = h("ul", { class: "folders", "data-testid": "folders", tabindex: -1 });

  /** @param {string} path */
  async function show(path) {
    try {
      /** @type {Api.FolderListing} */
      const listing = await app.api.get(`/api/folders?path=${encodeURIComponent(path)}`);
      crumbs.replaceChildren(...makeCrumbs(listing.path, show));
      list.replaceChildren(
        ...(listing.entries.length
          ? listing.entries.map((entry) => makeEntry(entry, show, options))
          : [nothing(listing.path)]),
      );
      list.focus();
    } catch (error) {
      list.replaceChildren(h("li", { class: "error-box", role: "alert" }, messageOf(error)));
    }
  }

  return { nodes: [crumbs, list], show };
}

/** @param {string} path */
function nothing(path) {
  const text = path
    ? "This folder is empty."
    : "The server has no folder with recordings. Start it with --folder PATH.";
  return h("li", { class: "empty" }, text);
}

/**
 * @param {string} path
 * @param {(path: string) => void} show
 */
function makeCrumbs(path, show) {
  const parts = path ? path.split("/") : [];
  /**
   * @param {string} text
   * @param {string} target
   */
  const step = (text, target) => h("button", { type: "button", class: "quiet", onclick: () => show(target) }, text);
  return [
    step("Folders", ""),
    ...parts.flatMap((part, i) => [h("span", { class: "muted" }, "/"), step(part, parts.slice(0, i + 1).join("/"))]),
  ];
}

/**
 * @param {Api.FolderEntry} entry
 * @param {(path: string) => void} show
 * @param {Picker} options
 */
function makeEntry(entry, show, { text, testid, onPick }) {
  const name = h("span", { class: "grow ellipsis", title: entry.name }, entry.name);
  const openButton = h(
    "button",
    { type: "button", class: "quiet entry", onclick: () => show(entry.path), "data-testid": `folder-${entry.name}` },
    glyph("folder"),
    name,
  );
  if (entry.recording === null) return h("li", {}, openButton);
  /** @type {HTMLButtonElement} */
  const button = h(
    "button",
    {
      type: "button",
      class: "primary",
      "data-testid": `${testid}-${entry.name}`,
      onclick: () => onPick(entry, button),
    },
    text,
  );
  return h(
    "li",
    { class: "entry recording" },
    entry.is_folder ? openButton : name,
    h("span", { class: "chip format" }, entry.recording),
    button,
  );
}
