/** Checks: boxes that look wrong, by what looks wrong; a click opens the frame and the box in Review. */

import { count, h } from "../dom.js";
import { makeHash } from "../router.js";

const KINDS = [
  ["class", "Unknown class", "the project does not have this class"],
  ["empty", "Hardly any points inside", "the box may be in the wrong place"],
  ["size", "Unusual size", "far from the median of the class"],
  ["heading", "Heading jumps", "turned far against the neighbouring frame"],
  ["track", "Tracks", "two boxes of one object in a frame, or of two classes"],
  ["duplicate", "Overlapping boxes", "two boxes may stand for one object"],
];
/** More than this in one group are counted, not listed. */
const LISTED = 200;

export function mount(root, app) {
  const body = h("div", { class: "stack" }, h("p", { class: "muted" }, "Looking at all boxes …"));
  const note = h("span", { class: "muted", role: "status", "data-testid": "checks-note" });
  const again = h("button", { type: "button", "data-testid": "check-again", onclick: () => void load() }, "Check again");
  root.append(h("div", { class: "page", "data-testid": "checks" }, h("div", { class: "row" }, h("h1", {}, "Checks"), note, h("span", { class: "grow" }), again), body));
  let ended = false;
  let timer = 0;

  async function load() {
    clearTimeout(timer);
    again.disabled = true;
    try {
      const report = await app.api.get(app.path("checks"));
      if (ended) return;
      show(report);
      // the server stops after a few seconds, and goes on where it was
      if (report.uncounted > 0) timer = setTimeout(load, 200);
    } catch (error) {
      if (!ended) body.replaceChildren(h("p", { class: "error-box", role: "alert" }, error.message));
    } finally {
      again.disabled = false;
    }
  }

  function show({ warnings, labels, unreadable, uncounted }) {
    note.textContent = uncounted > 0 ? `Counting points: ${count(uncounted, "frame")} to go …` : `${count(labels, "box was", "boxes were")} looked at.`;
    const failed = unreadable.length ? [h("div", { class: "error-box", role: "alert" }, `These frames could not be read:\n${unreadable.join("\n")}`)] : [];
    if (warnings.length === 0) {
      const nothing = labels === 0 ? ["There is no box yet", "Label objects, or let the detectors propose some, and come back."] : ["Nothing looks wrong", "Sizes, points, headings and overlaps of all boxes were looked at."];
      body.replaceChildren(...failed, h("div", { class: "empty panel", "data-testid": "no-warnings" }, h("h2", {}, nothing[0]), h("p", {}, nothing[1])));
      return;
    }
    const unknown = [...new Set(warnings.map(({ kind }) => kind))].filter((kind) => !KINDS.some(([name]) => name === kind)).map((kind) => [kind, kind, ""]);
    const groups = [...KINDS, ...unknown].map(([kind, title, help]) => [title, help, kind, warnings.filter((warning) => warning.kind === kind)]).filter(([, , , found]) => found.length > 0);
    body.replaceChildren(...failed, ...groups.map(group));
  }

  function group([title, help, kind, found]) {
    const rows = found.slice(0, LISTED).map(row);
    if (found.length > LISTED) rows.push(h("li", { class: "muted pad" }, `and ${count(found.length - LISTED, "more", "more")}`));
    return h(
      "section",
      { class: "panel", "data-testid": `checks-${kind}` },
      h("header", {}, h("h2", {}, title), h("span", { class: "chip number" }, String(found.length)), h("span", { class: "muted" }, help)),
      h("ul", { class: "warnings" }, rows),
    );
  }

  function row({ frame, key, recording, uid, message }) {
    const href = makeHash(app.state.route.project, "review", frame, { uid });
    return h("li", {}, h("a", { href, "data-testid": "warning", "data-uid": uid }, h("span", { class: "grow" }, message), h("span", { class: "muted number" }, `${recording} ${key}`)));
  }

  void load();
  return {
    unmount() {
      ended = true;
      clearTimeout(timer);
    },
  };
}
