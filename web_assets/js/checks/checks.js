/** Checks: boxes that look wrong, by kind of problem. A click opens the box, or the frame. */

import { button, count, h, patch } from "../dom.js";
import { messageOf } from "../errors.js";
import { makeHash } from "../router.js";

/** @type {string[][]} */
const KINDS = [
  ["class", "Unknown class", "the project has no such class"],
  ["attribute", "Attribute", "a value is missing, does not fit, has no attribute, or differs along its track"],
  ["empty", "Hardly any points inside", "the box may be in the wrong place"],
  ["size", "Unusual size", "far from the median of the class"],
  ["heading", "Heading jumps", "very different from the neighbouring frame"],
  ["track", "Tracks", "one track has two boxes in a frame, or two classes"],
  ["duplicate", "Overlapping boxes", "two boxes may be the same object"],
];
/** Maximum number of warnings that a group lists; all are counted. */
const LISTED = 200;

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  const body = h("div", { class: "stack" }, h("p", { class: "muted" }, "Checking all boxes …"));
  const note = h("span", { class: "muted", role: "status", "data-testid": "checks-note" });
  const again = button("Check again", () => void load(), { "data-testid": "check-again" });
  root.append(
    h(
      "div",
      { class: "page", "data-testid": "checks" },
      h("div", { class: "row" }, h("h1", {}, "Checks"), note, h("span", { class: "grow" }), again),
      body,
    ),
  );
  let ended = false;
  let timer = 0;

  async function load() {
    clearTimeout(timer);
    again.disabled = true;
    try {
      /** @type {Api.CheckReport} */
      const report = await app.api.get(app.path("checks"));
      if (ended) return;
      show(report);
      // the server stops after a few seconds; the next request continues
      if (report.uncounted > 0) timer = setTimeout(load, 200);
    } catch (error) {
      if (!ended) patch(body, h("p", { class: "error-box", role: "alert" }, messageOf(error)));
    } finally {
      again.disabled = false;
    }
  }

  function show(/** @type {Api.CheckReport} */ { warnings, labels, unreadable, uncounted }) {
    note.textContent =
      uncounted > 0
        ? `Counting points: ${count(uncounted, "frame")} left …`
        : `${count(labels, "box", "boxes")} checked.`;
    const failed = unreadable.length
      ? [h("div", { class: "error-box", role: "alert" }, `What cannot be read:\n${unreadable.join("\n")}`)]
      : [];
    if (warnings.length === 0) {
      const nothing =
        labels === 0
          ? ["No boxes yet", "Draw some, or let the detectors propose them.", "annotate", "Annotate"]
          : [
              "Nothing looks wrong",
              "Sizes, points, headings and overlaps were checked.",
              "export",
              "Export the boxes",
            ];
      patch(
        body,
        failed,
        h(
          "div",
          { class: "empty panel", "data-testid": "no-warnings" },
          h("h2", {}, nothing[0]),
          h("p", {}, nothing[1]),
          h("a", { class: "button", href: makeHash(app.state.route.project, nothing[2]) }, nothing[3]),
        ),
      );
      return;
    }
    const kinds = new Set(warnings.map(({ kind }) => kind));
    for (const [kind] of KINDS) kinds.delete(/** @type {Api.Kind} */ (kind));
    const unknown = [...kinds].map((kind) => [kind, kind, ""]);
    const groups = [...KINDS, ...unknown].flatMap(([kind, title, help]) => {
      const matching = warnings.filter((warning) => warning.kind === kind);
      return matching.length > 0 ? [group(kind, title, help, matching)] : [];
    });
    patch(body, failed, groups);
  }

  function group(
    /** @type {string} */ kind,
    /** @type {string} */ title,
    /** @type {string} */ help,
    /** @type {Api.WarningRow[]} */ matching,
  ) {
    const rows = matching.slice(0, LISTED).map(row);
    if (matching.length > LISTED)
      rows.push(h("li", { class: "muted pad" }, `and ${count(matching.length - LISTED, "more", "more")}`));
    return h(
      "section",
      { class: "panel", "data-testid": `checks-${kind}` },
      h(
        "header",
        {},
        h("h2", {}, title),
        h("span", { class: "chip number" }, String(matching.length)),
        h("span", { class: "muted" }, help),
      ),
      h("ul", { class: "warnings" }, rows),
    );
  }

  function row(/** @type {Api.WarningRow} */ { frame, key, recording, uid, message }) {
    const href = makeHash(app.state.route.project, "annotate", frame, { uid });
    return h(
      "li",
      {},
      h(
        "a",
        { href, "data-testid": "warning", "data-uid": uid },
        h("span", { class: "grow" }, message),
        h("span", { class: "muted number" }, `${recording}, frame ${key}`),
      ),
    );
  }

  void load();
  return {
    unmount() {
      ended = true;
      clearTimeout(timer);
    },
  };
}
