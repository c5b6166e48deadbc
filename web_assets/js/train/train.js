/** Train and propose: the training data, the running training, the models, and proposals. */

import { count, h, patch } from "../dom.js";
import { messageOf } from "../errors.js";
import { createJobLine, isActive, latestJob, startJob } from "../jobs.js";
import { createCurves } from "./curves.js";
import { createModelList } from "./models.js";
import { createPropose } from "./propose.js";

/** The server's defaults, which empty fields show. */
const PICTURES = { image: 2800, view: 48000 };
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
      if (changes === learning.changes) learning.show(answer.learn_every);
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
  /** @type {number | null | undefined} */
  let stored;
  let changes = 0;

  async function store() {
    changes += 1;
    const wanted = box.checked ? every.valueAsNumber || LEARN_EVERY : null;
    try {
      await app.api.put(app.path("models", "learning"), { every: wanted });
      stored = wanted;
    } catch (error) {
      app.toast(error);
    }
    fill();
  }

  function fill() {
    box.checked = typeof stored === "number";
    if (typeof stored === "number") every.value = String(stored);
  }

  box.addEventListener("change", store);
  every.addEventListener("change", () => box.checked && store());
  const root = h(
    "div",
    { class: "stack", "data-testid": "learning" },
    h(
      "div",
      { class: "row" },
      h("label", { class: "row" }, box, "Learn while I label"),
      h("label", { class: "row" }, "after every", every, "reviewed boxes"),
    ),
    h(
      "p",
      { class: "help" },
      "Trains the view detector for three minutes in the background, while a page has this project open. It waits ",
      "while you draw and stops for other jobs. A better detector is used at once.",
    ),
  );
  return {
    root,
    /** How often the operator has changed the switch. */
    get changes() {
      return changes;
    },
    show(/** @type {number | null} */ now) {
      if (now === stored) return;
      stored = now;
      fill();
    },
  };
}

function createForm(/** @type {ModeApp} */ app) {
  const roles = ROLES.map(([role]) =>
    h("input", { type: "checkbox", name: role, checked: true, "data-testid": `train-role-${role}` }),
  );
  const pictures = ROLES.map(([role, label]) =>
    h("input", {
      type: "number",
      min: 16,
      max: 1000000,
      step: 1,
      placeholder: String(PICTURES[role]),
      "aria-label": `Pictures for the ${label.toLowerCase()}`,
      "data-testid": `train-pictures-${role}`,
    }),
  );
  const sizes = ROLES.map(([role, label]) =>
    h("input", {
      type: "number",
      min: 32,
      max: 2048,
      step: 32,
      placeholder: String(SIZES_PX[role]),
      "aria-label": `Size of the pictures for the ${label.toLowerCase()}`,
      "data-testid": `train-size-${role}`,
    }),
  );
  const minutes = h("input", {
    type: "number",
    min: 0.5,
    max: 1440,
    step: 0.5,
    placeholder: "3",
    "aria-label": "Minutes for the view detector",
    "data-testid": "train-minutes",
  });
  const model = h(
    "select",
    { "data-testid": "train-model" },
    [
      ["", "yolo11n: small and fast (default)"],
      ["yolo11s", "yolo11s: larger, slower"],
      ["yolo11m", "yolo11m: for a GPU"],
    ].map(([value, text]) => h("option", { value }, text)),
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
        h("label", { class: "field" }, h("span", {}, `${label}: pictures shown`), pictures[i]),
      ),
      ROLES.map(([, label], i) =>
        h("label", { class: "field" }, h("span", {}, `${label}: longer side, px`), sizes[i]),
      ),
      h("label", { class: "field" }, h("span", {}, "View detector: minutes"), minutes),
      h("label", { class: "field" }, h("span", {}, "Network"), model),
      h(
        "p",
        { class: "help" },
        "Each picture is shown many times, with small random changes. More pictures take longer and train better; ",
        "larger pictures show small objects better. An empty field uses the number shown in grey. ",
        "A view detector that starts from another one trains for this many minutes. After the first three, it ",
        "is used at once if it is better. Beyond three minutes, the image detector learns longer, too. ",
        "A fifth of the frames is never used for training: it decides which one is used.",
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
      h("span", { class: "grow" }),
      start,
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
        image_pictures: number(pictures[0]),
        view_pictures: number(pictures[1]),
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
    h("p", {}, "There are no boxes to train on yet. Draw a few objects first; each takes five 2D boxes."),
    h("a", { class: "button", href: `#/${encodeURIComponent(app.state.route.project)}/annotate` }, "Label objects"),
  );
}

/** Curves of the running training, or else of the active models. */
function curvesOf(/** @type {Api.Job | null} */ job, /** @type {Api.ModelList | null} */ known) {
  if (job && (isActive(job) || job.curves.length > 0) && job.state !== "done") return job.curves;
  const active = known?.models.filter((model) => model.active) ?? [];
  const kept = active.flatMap((model) => model.curves);
  return kept.length ? kept : (job?.curves ?? []);
}
