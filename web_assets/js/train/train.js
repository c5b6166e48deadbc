/** Train and propose: the training data, the running training, the models, and proposals. */

import { newest } from "../api.js";
import { count, h, nothing, patch } from "../dom.js";
import { checkbox, field, numberField, numberOf, remembered, select } from "../forms.js";
import { createJobForm, createJobLine, isActive, latestJob } from "../jobs.js";
import { makeHash } from "../router.js";
import { createCurves } from "./curves.js";
import { createModelList } from "./models.js";
import { createPropose } from "./propose.js";

/** The server's defaults, which empty fields show. */
const MINUTES = 3;
const LEARN_EVERY = 20;
const SIZES_PX = { image: 192, view: 64 };
/** @type {[Api.DetectorKind, string, string, string | null][]} */
const ROLES = [
  ["image", "Image detector", "finds objects on the camera image", null],
  [
    "view",
    "View detector",
    "finds their edges on pseudo-views",
    "Each 3D box gives several training pictures, from different directions.",
  ],
];
const NETWORKS = [
  ["", "yolo11n: small and fast (default)"],
  ["yolo11s", "yolo11s: larger, slower"],
  ["yolo11m", "yolo11m: for a GPU"],
];

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  const material = h("div.cards");
  const line = createJobLine(app, "train");
  const curves = createCurves();
  const modelsHost = h("section.panel");
  const proposeHost = h("section.panel");
  const models = createModelList(modelsHost, app, load);
  const propose = createPropose(proposeHost, app);
  const { form, start } = createForm(app, show);
  /** An answer from before a change of the learning is out of date. */
  const begin = newest();
  const learning = createLearning(app, begin);
  /** @type {Api.ModelList | null} */
  let known = null;

  root.append(
    h("div.page.wide.train-page", [
      h("h1", "Train and propose"),
      h("section.panel", [
        h("header", h("h2", "Train the detectors")),
        h("div.body.stack", material, form, learning.root, line, h("div", curves.root)),
      ]),
      proposeHost,
      modelsHost,
    ]),
  );

  async function load() {
    const isNewest = begin();
    const answer = await app.api.get(app.path("models"));
    if (until.aborted) return;
    known = answer;
    if (isNewest()) learning.show(answer);
    show();
  }

  function show() {
    const job = latestJob(app, "train");
    curves.show(curvesOf(job, known));
    propose.show();
    // a round in the background stops for this one
    start.disabled = isActive(job) && !job?.background;
    if (!known) return;
    models.show(known);
    propose.setToLift(known.material.to_lift);
    const hasNone = Object.values(known.material).every((number) => number === 0);
    form.hidden = hasNone;
    const cards = ROLES.map((role) => materialCard(role, /** @type {Api.ModelList} */ (known)));
    const text = "There are no boxes to train on yet. Draw a few objects, and accept their boxes, first.";
    patch(material, cards, hasNone && nothing("", text, makeHash(app.state.route.project, "annotate"), "Annotate"));
  }

  const states = () => app.state.jobs.map(({ id, state }) => `${id}${state}`).join();
  let last = states();
  function showJobs() {
    show();
    // new models and proposals change other parts of the page
    const now = states();
    if (now !== last) {
      void load();
      void app.refreshProject();
    }
    last = now;
  }

  app.state.on("jobs", showJobs, until);
  app.state.on("project", () => propose.show(), until);
  until.addEventListener("abort", curves.destroy);
  show();
  void load();
  void app.refreshProject();
}

/** A field for minutes, everywhere with the same limits. */
const minutesField = (/** @type {string} */ label, /** @type {string} */ testid) =>
  numberField(testid, label, { min: 0.5, max: 1440, step: 0.5, value: MINUTES });

/** The switch "Learn while I label"; `begin` is called with each change. */
function createLearning(/** @type {ModeApp} */ app, /** @type {() => unknown} */ begin) {
  const limits = { min: 1, max: 1000000, value: LEARN_EVERY };
  const box = checkbox("learn-switch");
  const every = numberField("learn-every", "Reviewed boxes between two rounds", limits);
  const minutes = minutesField("Minutes of a round", "learn-minutes");
  let stored = "";

  async function store() {
    begin();
    const body = {
      every: box.checked ? every.valueAsNumber || LEARN_EVERY : null,
      minutes: minutes.valueAsNumber || MINUTES,
    };
    await app.api.put(app.path("models", "learning"), body);
    show({ learn_every: body.every, learn_minutes: body.minutes });
  }

  /** What is typed stays until something else is stored. */
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
  const root = h("div.stack", { "data-testid": "learning" }, [
    h("div.row", [
      h("label.row", box, "Learn while I label"),
      h("label.row", "after every", every, "reviewed boxes,"),
      h("label.row", "for", minutes, "minutes"),
    ]),
    h("p.help", [
      "Trains the view detector in the background, while a page has this project open. It waits while you draw and ",
      "stops for other jobs. A detector that is better on held-out frames is used at once.",
    ]),
  ]);
  return { root, show };
}

function createForm(/** @type {ModeApp} */ app, /** @type {() => unknown} */ show) {
  const roles = ROLES.map(([role]) =>
    remembered(app, "train", role, checkbox(`train-role-${role}`, true, { name: role })),
  );
  const sizes = ROLES.map(([role, label]) => {
    const text = `Size of the pictures for the ${label.toLowerCase()}`;
    const limits = { min: 32, max: 2048, step: 32, placeholder: String(SIZES_PX[role]) };
    return remembered(app, "train", `size ${role}`, numberField(`train-size-${role}`, text, limits));
  });
  const minutes = remembered(app, "train", "minutes", minutesField("Minutes of the training", "train-minutes"));
  const model = remembered(app, "train", "model", select(NETWORKS, { "data-testid": "train-model" }));
  const made = createJobForm(app, {
    name: "train",
    label: "Train",
    content: (start) => [
      h("div.row", [
        ROLES.map(([, label], i) => h("label.row", roles[i], label)),
        h("label.row", "for", minutes, "minutes"),
        h("span.grow"),
        start,
      ]),
      h("p.help", [
        "More minutes train better. They are those of the view detector; the image detector learns longer with them. ",
        "A fifth of the frames is never trained on: a detector that is worse on these than the one in use, or finds ",
        "nothing, is not used unless you choose it below.",
      ]),
      h("details", [
        h("summary", "Settings"),
        h("div.settings", [
          ROLES.map(([, label], i) => field(`${label}: longer side, px`, sizes[i])),
          field("Network", model),
          h(
            "p.help",
            "Larger pictures show small objects better, and take longer. An empty field uses the number shown in grey.",
          ),
        ]),
      ]),
    ],
    request() {
      const chosen = ROLES.map(([role]) => role).filter((_, i) => roles[i].checked);
      if (chosen.length === 0) throw new Error("Choose at least one detector to train.");
      return {
        kind: "train",
        roles: chosen,
        minutes: numberOf(minutes),
        image_size_px: numberOf(sizes[0]),
        view_size_px: numberOf(sizes[1]),
        model: model.value || null,
      };
    },
    show,
  });
  // until it is known that there is something to learn
  made.form.hidden = true;
  return made;
}

function materialCard(
  /** @type {(typeof ROLES)[number]} */ [role, label, what, help],
  /** @type {Api.ModelList} */ { models, material },
) {
  const active = models.find((model) => model.role === role && model.active);
  const learned = active ? (active.boxes === null ? "unknown" : count(active.boxes, "box")) : "nothing yet";
  const available = `${count(material[role], "drawn box")} and ${count(material.labels, "reviewed 3D box")}`;
  const figures = [
    ["trained on", learned],
    ["available now", available],
  ].map(([name, value]) => [h("dt", name), h("dd.number", value)]);
  return h("div.card", { "data-testid": `material-${role}` }, [
    h("h3", label),
    h("p.muted", what),
    h("dl.figures", figures.flat()),
    help && h("p.help", help),
  ]);
}

/** Curves of the running training, or else of the active models. */
function curvesOf(/** @type {Api.Job | undefined} */ job, /** @type {Api.ModelList | null} */ known) {
  if (job && (isActive(job) || job.curves.length > 0) && job.state !== "done") return job.curves;
  const active = known?.models.filter((model) => model.active) ?? [];
  const kept = active.flatMap((model) => model.curves);
  return kept.length ? kept : (job?.curves ?? []);
}
