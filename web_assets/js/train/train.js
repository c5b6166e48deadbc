/** Train and propose: the training data, the running training, the models, and proposals. */

import { count, h, patch, remembered } from "../dom.js";
import { messageOf } from "../errors.js";
import { createJobLine, isActive, latestJob, startJob } from "../jobs.js";
import { createCurves } from "./curves.js";
import { createModelList } from "./models.js";
import { createPropose } from "./propose.js";

/** The server's defaults, which empty fields show. */
const MINUTES = 3;
const LEARN_EVERY = 20;
const SIZES_PX = { image: 192, view: 64 };
/** @type {[Api.DetectorKind, string, string][]} */
const ROLES = [
  ["image", "Image detector", "finds objects on the camera image"],
  ["view", "View detector", "finds their edges on pseudo-views"],
];

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  const material = h("div", { class: "cards" });
  const line = createJobLine(app, "train");
  const curvesHost = h("div", {});
  const curves = createCurves(curvesHost);
  const modelsHost = h("section", { class: "panel" });
  const proposeHost = h("section", { class: "panel" });
  const models = createModelList(modelsHost, app, load);
  const propose = createPropose(proposeHost, app);
  const { form, start } = createForm(app);
  const learning = createLearning(app);
  /** @type {Api.ModelList | null} */
  let known = null;
  let ended = false;

  root.append(
    h(
      "div",
      { class: "page wide train-page" },
      h("h1", {}, "Train and propose"),
      h(
        "section",
        { class: "panel" },
        h("header", {}, h("h2", {}, "Train the detectors")),
        h("div", { class: "body stack" }, material, form, learning.root, line.root, curvesHost),
      ),
      proposeHost,
      modelsHost,
    ),
  );

  async function load() {
    try {
      const { changes } = learning;
      /** @type {Api.ModelList} */
      const answer = await app.api.get(app.path("models"));
      if (ended) return;
      known = answer;
      // an answer from before a change is out of date
      if (changes === learning.changes) learning.show(answer);
      show();
    } catch (error) {
      app.toast(error);
    }
  }

  function show() {
    const job = latestJob(app, "train");
    line.show();
    curves.show(curvesOf(job, known));
    propose.show();
    // a round in the background stops for this one
    start.disabled = Boolean(job && isActive(job) && !job.background);
    if (!known) return;
    const list = known;
    models.show(known);
    propose.setToLift(known.material.to_lift);
    const nothing = Object.values(known.material).every((number) => number === 0);
    form.hidden = nothing;
    patch(
      material,
      ROLES.map((role) => materialCard(role, list)),
      nothing && nothingYet(app),
    );
  }

  const states = () => app.state.jobs.map(({ id, state }) => `${id}${state}`).join();
  let last = states();
  const stop = [
    app.state.on("jobs", () => {
      show();
      // new models and proposals change other parts of the page
      const now = states();
      if (now !== last) {
        void load();
        app.refreshProject().then(() => !ended && show(), app.toast);
      }
      last = now;
    }),
    app.state.on("project", () => propose.show()),
  ];
  show();
  void load();
  app.refreshProject().catch(app.toast);
  return {
    unmount() {
      ended = true;
      for (const end of stop) end();
      curves.destroy();
    },
  };
}

/** A field for minutes, everywhere with the same limits. */
const minutesField = (/** @type {string} */ label, /** @type {string} */ testid) =>
  h("input", {
    type: "number",
    min: 0.5,
    max: 1440,
    step: 0.5,
    value: MINUTES,
    "aria-label": label,
    "data-testid": testid,
  });

/** The switch "Learn while I label". */
function createLearning(/** @type {ModeApp} */ app) {
  const box = h("input", { type: "checkbox", "data-testid": "learn-switch" });
  const every = h("input", {
    type: "number",
    min: 1,
    max: 1000000,
    value: LEARN_EVERY,
    "aria-label": "Reviewed boxes between two rounds",
    "data-testid": "learn-every",
  });
  const minutes = minutesField("Minutes of a round", "learn-minutes");
  let stored = "";
  let changes = 0;

  async function store() {
    changes += 1;
    const everyNow = box.checked ? every.valueAsNumber || LEARN_EVERY : null;
    const minutesNow = minutes.valueAsNumber || MINUTES;
    try {
      await app.api.put(app.path("models", "learning"), { every: everyNow, minutes: minutesNow });
      show({ learn_every: everyNow, learn_minutes: minutesNow });
    } catch (error) {
      app.toast(error);
    }
  }

  function show(/** @type {Pick<Api.ModelList, "learn_every" | "learn_minutes">} */ { learn_every, learn_minutes }) {
    const now = `${learn_every} ${learn_minutes}`;
    if (now === stored) return;
    stored = now;
    box.checked = learn_every !== null;
    if (learn_every !== null) every.value = String(learn_every);
    minutes.value = String(learn_minutes);
  }

  for (const field of [box, every, minutes])
    field.addEventListener("change", () => (box.checked || field === box) && store());
  const root = h(
    "div",
    { class: "stack", "data-testid": "learning" },
    h(
      "div",
      { class: "row" },
      h("label", { class: "row" }, box, "Learn while I label"),
      h("label", { class: "row" }, "after every", every, "reviewed boxes,"),
      h("label", { class: "row" }, "for", minutes, "minutes"),
    ),
    h(
      "p",
      { class: "help" },
      "Trains the view detector in the background, while a page has this project open. It waits while you draw and ",
      "stops for other jobs. A detector that is better on held-out frames is used at once.",
    ),
  );
  return {
    root,
    /** How often the operator has changed the switch. */
    get changes() {
      return changes;
    },
    show,
  };
}

function createForm(/** @type {ModeApp} */ app) {
  /** @template {HTMLInputElement | HTMLSelectElement} T */
  const kept = (/** @type {string} */ key, /** @type {T} */ field) =>
    remembered(`train ${app.state.route.project} ${key}`, field);
  const roles = ROLES.map(([role]) =>
    kept(role, h("input", { type: "checkbox", name: role, checked: true, "data-testid": `train-role-${role}` })),
  );
  const sizes = ROLES.map(([role, label]) =>
    kept(
      `size ${role}`,
      h("input", {
        type: "number",
        min: 32,
        max: 2048,
        step: 32,
        placeholder: String(SIZES_PX[role]),
        "aria-label": `Size of the pictures for the ${label.toLowerCase()}`,
        "data-testid": `train-size-${role}`,
      }),
    ),
  );
  const minutes = kept("minutes", minutesField("Minutes of the training", "train-minutes"));
  const model = kept(
    "model",
    h(
      "select",
      { "data-testid": "train-model" },
      [
        ["", "yolo11n: small and fast (default)"],
        ["yolo11s", "yolo11s: larger, slower"],
        ["yolo11m", "yolo11m: for a GPU"],
      ].map(([value, text]) => h("option", { value }, text)),
    ),
  );
  const start = h("button", { type: "submit", class: "primary", "data-testid": "train-start" }, "Train");
  const problem = h("p", { class: "error-box", role: "alert", hidden: true });
  const more = h(
    "details",
    {},
    h("summary", {}, "Settings"),
    h(
      "div",
      { class: "settings" },
      ROLES.map(([, label], i) =>
        h("label", { class: "field" }, h("span", {}, `${label}: longer side, px`), sizes[i]),
      ),
      h("label", { class: "field" }, h("span", {}, "Network"), model),
      h(
        "p",
        { class: "help" },
        "Larger pictures show small objects better, and take longer. An empty field uses the number shown in grey.",
      ),
    ),
  );
  const form = h(
    "form",
    // hidden until it is known that there is something to learn
    { class: "stack", hidden: true, "data-testid": "train-form" },
    h(
      "div",
      { class: "row" },
      ROLES.map(([, label], i) => h("label", { class: "row" }, roles[i], label)),
      h("label", { class: "row" }, "for", minutes, "minutes"),
      h("span", { class: "grow" }),
      start,
    ),
    h(
      "p",
      { class: "help" },
      "More minutes train better. They are those of the view detector; the image detector learns longer with them. A ",
      "fifth of the frames is never trained on: a detector that is worse on these than the one in use, or finds nothing, ",
      "is not used unless you choose it below.",
    ),
    more,
    problem,
  );
  const number = (/** @type {HTMLInputElement} */ input) => (input.value === "" ? null : input.valueAsNumber);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    problem.hidden = true;
    start.disabled = true;
    try {
      const chosen = ROLES.map(([role]) => role).filter((_, i) => roles[i].checked);
      if (chosen.length === 0) throw new Error("Choose at least one detector to train.");
      await startJob(app, {
        kind: "train",
        roles: chosen,
        minutes: number(minutes),
        image_size_px: number(sizes[0]),
        view_size_px: number(sizes[1]),
        model: model.value || null,
      });
    } catch (error) {
      problem.textContent = messageOf(error);
      problem.hidden = false;
      start.disabled = false;
    }
  });
  return { form, start };
}

function materialCard(
  /** @type {(typeof ROLES)[number]} */ [role, label, what],
  /** @type {Api.ModelList} */ { models, material },
) {
  const active = models.find((model) => model.role === role && model.active);
  const learned = active ? (active.boxes === null ? "unknown" : count(active.boxes, "box", "boxes")) : "nothing yet";
  return h(
    "div",
    { class: "card", "data-testid": `material-${role}` },
    h("h3", {}, label),
    h("p", { class: "muted" }, what),
    h(
      "dl",
      { class: "figures" },
      h("dt", {}, "trained on"),
      h("dd", { class: "number" }, learned),
      h("dt", {}, "available now"),
      h(
        "dd",
        { class: "number" },
        `${count(material[role], "drawn box", "drawn boxes")} and `,
        count(material.labels, "reviewed 3D box", "reviewed 3D boxes"),
      ),
    ),
    role === "view"
      ? h("p", { class: "help" }, "Each 3D box gives several training pictures, from different directions.")
      : null,
  );
}

function nothingYet(/** @type {ModeApp} */ app) {
  return h(
    "div",
    { class: "empty" },
    h("p", {}, "There are no boxes to train on yet. Draw a few objects, and accept their boxes, first."),
    h("a", { class: "button", href: `#/${encodeURIComponent(app.state.route.project)}/annotate` }, "Annotate"),
  );
}

/** Curves of the running training, or else of the active models. */
function curvesOf(/** @type {Api.Job | null} */ job, /** @type {Api.ModelList | null} */ known) {
  if (job && (isActive(job) || job.curves.length > 0) && job.state !== "done") return job.curves;
  const active = known?.models.filter((model) => model.active) ?? [];
  const kept = active.flatMap((model) => model.curves);
  return kept.length ? kept : (job?.curves ?? []);
}
