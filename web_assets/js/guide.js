/** The first minute: a strip below the page with the steps from a first drag to an export, for the sample project. */

import { h, iconButton, patch } from "./dom.js";
import { makeHash } from "./router.js";

/** The project that is guided, in this browser. */
const KEY = "guide";
/** @type {[string, string, string][]} */
const STEPS = [
  ["Drag a box around a person on the image", "", "annotate"],
  ["takes the dashed box", "Space", "annotate"],
  ["follows the person", "V", "annotate"],
  ["accepts what was found", "Space", "annotate"],
  ["Export the boxes", "", "export"],
];

let show = () => {};

/** Guides the operator through a project; null ends it. */
export function guide(/** @type {string | null} */ project) {
  if (project === null) localStorage.removeItem(KEY);
  else localStorage.setItem(KEY, project);
  show();
}

/**
 * The number of steps that are done.
 *
 * @param {Record<string, number>} labels numbers of the project's, by state.
 * @param {boolean} isExported
 */
export function stepsDone({ proposed = 0, accepted = 0, edited = 0 }, isExported) {
  const reviewed = accepted + edited;
  if (isExported) return STEPS.length;
  if (!reviewed) return 0;
  if (reviewed + proposed < 2) return 2;
  return proposed ? 3 : 4;
}

/** Adds the strip; its place is there as long as the project is guided, so that nothing moves. */
export function mountGuide(/** @type {App} */ app) {
  const list = h("ol");
  const end = iconButton("close", "End the guide", () => guide(null), { "data-testid": "guide-end" });
  const root = h("footer.guide", { hidden: true, "aria-label": "First steps", "data-testid": "guide" }, list, end);
  document.body.append(root);

  show = () => {
    const { route, project, jobs } = app.state;
    const name = route.project;
    root.hidden = name === null || localStorage.getItem(KEY) !== name;
    if (root.hidden || !name) return;
    const isExported = jobs.some((job) => job.kind === "export" && job.project === name && job.state === "done");
    const done = stepsDone(project?.labels_by_state ?? {}, isExported);
    const isDone = done === STEPS.length;
    patch(
      list,
      STEPS.map(([text, key, mode], index) => {
        const isNow = index === done || (index === 1 && done === 0);
        const words = [key ? h("kbd", key) : null, ` ${text}`];
        const isElsewhere = isNow && mode !== route.mode;
        return h(
          "li",
          { class: index < done ? "done" : "", hidden: isDone, "aria-current": isNow ? "step" : null },
          isElsewhere ? h("a", { href: makeHash(name, mode) }, words) : words,
        );
      }),
      h("li", { hidden: !isDone }, "That is all. ", h("a", { href: "#/" }, "Make a project of your own")),
    );
  };
  for (const what of /** @type {const} */ (["route", "project", "jobs"])) app.state.on(what, () => show());
  // the numbers of a project's labels come with it
  app.state.on("frame", () => !root.hidden && app.refreshProject());
  show();
}
