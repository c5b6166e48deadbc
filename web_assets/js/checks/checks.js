/** Checks: boxes that look wrong, by kind of problem. A click opens the box, or the frame. */

import { button, count, h, nothing, patch } from "../dom.js";
import { errorBox } from "../forms.js";
import { makeHash } from "../router.js";

const KINDS = [
  ["class", "Unknown class", "the project has no such class"],
  ["attribute", "Attribute", "a value is missing, does not fit, has no attribute, or differs along its track"],
  ["empty", "Hardly any points inside", "the box may be in the wrong place"],
  ["size", "Unusual size", "far from the median of the class"],
  ["heading", "Heading jumps", "very different from the neighbouring frame, or against the way"],
  ["track", "Tracks", "one track has two boxes in a frame, two classes, or jumps"],
  ["duplicate", "Overlapping boxes", "two boxes may be the same object"],
];
/** Maximum number of warnings that a group lists; all are counted. */
const LISTED = 200;

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  const body = h("div.stack", h("p.muted", "Checking all boxes …"));
  const note = h("span.muted", { role: "status", "data-testid": "checks-note" });
  const again = button("Check again", () => void load(), { "data-testid": "check-again" });
  root.append(
    h("div.page", { "data-testid": "checks" }, h("div.row", h("h1", "Checks"), note, h("span.grow"), again), body),
  );
  let timer = 0;

  async function load() {
    clearTimeout(timer);
    again.disabled = true;
    try {
      const report = await app.api.get(app.path("checks"));
      if (until.aborted) return;
      show(report);
      // the server stops after a few seconds; the next request continues
      if (report.uncounted > 0) timer = setTimeout(load, 200);
    } catch (error) {
      if (!until.aborted) patch(body, errorBox(error));
    } finally {
      again.disabled = false;
    }
  }

  function show(/** @type {Api.CheckReport} */ { warnings, labels, unreadable, uncounted }) {
    note.textContent =
      uncounted > 0 ? `Counting points: ${count(uncounted, "frame")} left …` : `${count(labels, "box")} checked.`;
    const kinds = new Map(KINDS.map(([kind, ...words]) => [kind, words]));
    for (const { kind } of warnings) if (!kinds.has(kind)) kinds.set(kind, [kind, ""]);
    const groups = [...kinds].map(([kind, [title, help]]) => {
      const matching = warnings.filter((warning) => warning.kind === kind);
      return matching.length > 0 && group(kind, title, help, matching);
    });
    const failed = unreadable.length > 0 && errorBox(`What cannot be read:\n${unreadable.join("\n")}`);
    patch(body, failed, groups.some(Boolean) ? groups : nothingWrong(labels));
  }

  function nothingWrong(/** @type {number} */ labels) {
    const [title, text, mode, action] = labels
      ? ["Nothing looks wrong", "Sizes, points, headings and overlaps were checked.", "export", "Export the boxes"]
      : ["No boxes yet", "Draw some, or let the detectors propose them.", "annotate", "Annotate"];
    const said = nothing(title, text, makeHash(app.state.route.project, mode), action);
    said.classList.add("panel");
    said.dataset.testid = "no-warnings";
    return said;
  }

  function group(
    /** @type {string} */ kind,
    /** @type {string} */ title,
    /** @type {string} */ help,
    /** @type {Api.WarningRow[]} */ matching,
  ) {
    const rows = matching.slice(0, LISTED).map(row);
    if (matching.length > LISTED)
      rows.push(h("li.muted.pad", `and ${count(matching.length - LISTED, "more", "more")}`));
    return h("section.panel", { "data-testid": `checks-${kind}` }, [
      h("header", h("h2", title), h("span.chip.number", String(matching.length)), h("span.muted", help)),
      h("ul.warnings", rows),
    ]);
  }

  function row(/** @type {Api.WarningRow} */ { frame, number, key, recording, uid, message }) {
    const href = makeHash(app.state.route.project, "annotate", frame, { uid });
    return h(
      "li",
      h("a", { href, title: key, "data-testid": "warning", "data-uid": uid }, [
        h("span.grow", message),
        h("span.muted.number", `${recording}, frame ${number ?? key}`),
      ]),
    );
  }

  until.addEventListener("abort", () => clearTimeout(timer));
  void load();
}
