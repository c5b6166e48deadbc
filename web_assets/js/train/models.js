/** The trained models: training data, quality, which one is in use, and validation pictures. */

import { confirm } from "../dialogs.js";
import { button, count, dateOf, h, patch } from "../dom.js";

const ROLES = { image: "Image", view: "View" };
const HELD_OUT = "Held-out IoU";
const HELD_OUT_HELP =
  "Mean IoU with the reviewed boxes on held-out frames: a fixed fifth of the frames that is never used for training " +
  "and decides which detector is used.";
const METRICS = [
  ["map50", "mAP50"],
  ["map50_95", "mAP50-95"],
  ["precision", "Precision"],
  ["recall", "Recall"],
];
const HEADS = [
  ...["Detector", "Trained", "Trained on", ...METRICS.map(([, text]) => text)],
  ...[HELD_OUT, "Boxes enclose", "Use", "Examples"],
];

export function createModelList(
  /** @type {HTMLElement} */ host,
  /** @type {App} */ app,
  /** @type {() => Promise<void>} */ reload,
) {
  const pictures = h("div.thumbs", { "data-testid": "validation-pictures" });
  const table = h("div.scroll-x");
  host.append(h("header", h("h2", "Models")), h("div.body.stack", pictures, table));
  /** @type {number | null} */
  let shown = null;

  async function activate(/** @type {string | number} */ id, /** @type {string} */ name) {
    await app.api.post(app.path("models", id, "activate"));
    app.toast(`${name} is in use now.`, "good");
    await reload();
  }

  /** Uses a detector; asks first if held-out frames have shown that it is worse than others, or finds nothing. */
  async function use(/** @type {Api.ModelDetails} */ { id, decision }) {
    const iou = decision?.mean_iou ?? null;
    const better = decision?.compared.filter(({ mean_iou }) => iou !== null && mean_iou > iou) ?? [];
    const others = ious(better, "the ").join(", ");
    const problem =
      iou === 0
        ? "It found none of the reviewed objects on held-out frames."
        : others && `On held-out frames it reached a mean IoU of ${iou?.toFixed(2)}, and ${others}.`;
    if (problem && !(await confirm(`Use model ${id} all the same?`, problem, "Use it"))) return;
    await activate(id, `Model ${id}`);
  }

  /** A row that says whether the detector is in use, or lets it be used. */
  const row = (
    /** @type {"model" | "base"} */ what,
    /** @type {number | null} */ id,
    /** @type {boolean} */ isUsed,
    /** @type {() => unknown} */ act,
    /** @type {Child[]} */ cells,
    /** @type {Child} */ examples = null,
  ) => {
    const attributes = { "data-testid": `${what}-row`, "data-id": id, "data-key": id, "data-active": String(isUsed) };
    const used = h("span.chip.state-accepted", "in use");
    const offered = button("Use this one", act, { "data-testid": `use-${what}` });
    return h(isUsed ? "tr.active" : "tr", attributes, cells, h("td", isUsed ? used : offered), h("td", examples));
  };

  const baseRow = (/** @type {"in use" | "available"} */ state) =>
    row("base", null, state === "in use", () => activate("base", "The base detector"), [
      h("td", ROLES.view),
      h(
        "td.muted",
        { colspan: METRICS.length + 4 },
        "Base detector: trained on generated scenes, not on this project's classes",
      ),
    ]);

  function modelRow(/** @type {Api.ModelDetails} */ model) {
    const { id, role, active, boxes, metrics, box_kind, decision } = model;
    const iou = decision?.mean_iou ?? null;
    const heldOut = iou === null ? "–" : `${iou.toFixed(2)} (${count(decision?.objects ?? 0, "object")})`;
    const why = decision
      ? [decision.started_from, ...ious(decision.compared), decision.outcome].join("\n")
      : HELD_OUT_HELP;
    const choose = () => {
      shown = id;
      showPictures(model);
    };
    const cells = [
      h("td", ROLES[role] ?? role),
      h("td.number", dateOf(model.created_ns / 1e6)),
      h("td.number", boxes === null ? "–" : count(boxes, "box")),
      ...METRICS.map(([name]) => h("td.number", metrics[name]?.toFixed(3) ?? "–")),
      h("td.number", { title: why, "data-testid": "held-out" }, heldOut),
      h("td", box_kind === "box" ? "the whole object" : "the visible part"),
    ];
    const examples = model.pictures.length > 0 && button("Pictures", choose, { class: "quiet" });
    return row("model", id, active, () => use(model), cells, examples);
  }

  function showPictures(/** @type {Api.ModelDetails | undefined} */ model) {
    pictures.hidden = !model?.pictures.length;
    if (!model) return;
    const words = "was not trained on: white boxes are the given ones, coloured ones what it finds.";
    const small = model.pictures.map((url, i) => {
      const label = `Validation picture ${i + 1}`;
      const opens = { href: url, target: "_blank", title: "Enlarge", "aria-label": label };
      return h("a.button.thumb", opens, h("img", { src: url, alt: "", loading: "lazy" }));
    });
    patch(pictures, h("p.muted", `What the ${model.role} detector ${words}`), h("div.row.thumbs-row", small));
  }

  return {
    show(/** @type {Api.ModelList} */ { models, base }) {
      const newest = models.toSorted((a, b) => b.created_ns - a.created_ns);
      const rows = [...newest.map(modelRow), base && baseRow(base)];
      const head = HEADS.map((text) =>
        h("th", { scope: "col", title: text === HELD_OUT ? HELD_OUT_HELP : null }, text),
      );
      const decisions = Object.keys(ROLES).map((each) =>
        decisionLine(newest.find(({ role, decision }) => role === each && decision)),
      );
      if (rows.some(Boolean))
        patch(table, h("table.dense.models", h("thead", h("tr", head)), h("tbody", rows)), decisions);
      else patch(table, h("p.muted", "No model has been trained yet."));
      const pictured = newest.filter((model) => model.pictures.length > 0);
      showPictures(pictured.find(({ id }) => id === shown) ?? pictured.find(({ active }) => active) ?? pictured[0]);
    },
  };
}

/** What detectors have reached, such as "base detector 0.61". */
const ious = (/** @type {Api.Rival[]} */ rivals, article = "") =>
  rivals.map(({ name, mean_iou }) => `${article}${name} ${mean_iou.toFixed(2)}`);

function decisionLine(/** @type {Api.ModelDetails | undefined} */ model) {
  const decision = model?.decision;
  if (!decision) return null;
  const figures = ious(decision.compared);
  if (decision.mean_iou !== null) figures.unshift(`newest detector ${decision.mean_iou.toFixed(2)}`);
  const measured = figures.length ? ` Mean IoU on held-out frames: ${figures.join(", ")}.` : "";
  return h("p.muted", { "data-testid": "decision" }, `Latest ${model.role} detector: ${decision.outcome}.${measured}`);
}
