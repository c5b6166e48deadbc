/** The dialog that browses the server's folders and adds recordings to a project. */

import { openDialog } from "../dialogs.js";
import { count, glyph, h } from "../dom.js";

/** Shows the folders until it is closed; several recordings can be added one after the other. */
export function addRecordings(app, project) {
  const crumbs = h("nav", { class: "crumbs", "aria-label": "Folder" });
  const list = h("ul", { class: "folders", "data-testid": "folders", tabindex: -1 });
  const done = h("div", { class: "added", role: "status" });
  const labels = h("input", { type: "checkbox", checked: true, "data-testid": "own-labels" });
  const browser = { app, project, crumbs, list, done, labels };
  const closed = openDialog({
    title: `Add recordings to ${project}`,
    testid: "add-recording-dialog",
    wide: true,
    content: [
      crumbs,
      list,
      h("label", { class: "row" }, labels, "Take over the 3D boxes that a recording brings, where it has any"),
      done,
    ],
    actions: [{ label: "Done", value: "done" }],
  });
  show(browser, "");
  return closed;
}

async function show(browser, path) {
  const { app, crumbs, list } = browser;
  try {
    const listing = await app.api.get(`/api/folders?path=${encodeURIComponent(path)}`);
    crumbs.replaceChildren(...makeCrumbs(browser, listing.path));
    list.replaceChildren(...(listing.entries.length ? listing.entries.map((entry) => makeEntry(browser, entry)) : [nothing(listing.path)]));
    list.focus();
  } catch (error) {
    list.replaceChildren(h("li", { class: "error-box", role: "alert" }, error.message));
  }
}

function nothing(path) {
  const text = path ? "Nothing in here." : "The server was told of no folder with recordings. Start it with --folder PATH, or put recordings where it may look.";
  return h("li", { class: "empty" }, text);
}

function makeCrumbs(browser, path) {
  const parts = path ? path.split("/") : [];
  const step = (text, target) => h("button", { type: "button", class: "quiet", onclick: () => show(browser, target) }, text);
  return [step("Folders", ""), ...parts.flatMap((part, i) => [h("span", { class: "muted" }, "/"), step(part, parts.slice(0, i + 1).join("/"))])];
}

function makeEntry(browser, entry) {
  const name = h("span", { class: "grow ellipsis", title: entry.name }, entry.name);
  if (entry.recording === null) {
    return h("li", {}, h("button", { type: "button", class: "quiet entry", onclick: () => show(browser, entry.path), "data-testid": `folder-${entry.name}` }, glyph("folder"), name));
  }
  const button = h("button", { type: "button", class: "primary", "data-testid": `add-${entry.name}`, onclick: () => add(browser, entry, button) }, "Add");
  return h("li", { class: "entry" }, name, h("span", { class: "chip format" }, entry.recording), button);
}

async function add({ app, project, done, labels }, entry, button) {
  button.disabled = true;
  button.textContent = "Adding …";
  try {
    const { added } = await app.api.post(`/api/projects/${encodeURIComponent(project)}/recordings`, { path: entry.path, labels: labels.checked });
    done.append(...added.map((one) => h("p", { "data-testid": "added-recording" }, glyph("check"), describe(one))));
    button.textContent = "Added";
  } catch (error) {
    done.append(h("p", { class: "error-box", role: "alert" }, error.message));
    button.textContent = "Add";
    button.disabled = false;
  }
}

function describe(added) {
  const { recording, is_new, new_frames, labels, left_out, unreadable } = added;
  const total = (counts) => Object.values(counts).reduce((sum, number) => sum + number, 0);
  const parts = [is_new ? `${recording.name}: ${count(recording.frames, "frame")}` : `${recording.name} was there already: ${count(new_frames, "new frame")}`];
  if (total(labels)) parts.push(`${count(total(labels), "box", "boxes")} taken over`);
  if (total(left_out)) parts.push(`${count(total(left_out), "box", "boxes")} of other classes left out (${Object.keys(left_out).join(", ")})`);
  if (unreadable.length) parts.push(`labels of ${count(unreadable.length, "frame")} could not be read`);
  return parts.join(", ");
}
