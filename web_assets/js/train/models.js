/** The trained models: training data, quality, which one is in use, and validation pictures. */

import { confirm, openDialog } from "../dialogs.js";
import { button, count, dateOf, h, patch } from "../dom.js";

const ROLES = { image: "Image", view: "View" };
const HELD_OUT_HELP =
  "Mean IoU with the reviewed boxes on held-out frames: a fixed fifth of the frames that is never used for training " +
  "and decides which detector is used.";
const COLUMNS = [
  ["map50", "mAP50"],
  ["map50_95", "mAP50-95"],
  ["precision", "Precision"],
  ["recall", "Recall"],
];

export function createModelList(
  /** @type {HTMLElement} */ host,
  /** @type {App} */ app,
  /** @type {() => Promise<void>} */ reload,
) {
  const pictures = h("div.thumbs", { "data-testid": "validation-pictures" });
  const table = h("div.scroll-x");
  const body = h("div.body.stack", pictures, table);
  host.append(h("header", h("h2", "Models")), body);
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
    const others = better.map(({ name, mean_iou }) => `the ${name} ${mean_iou.toFixed(2)}`).join(", ");
    const problem =
      iou === 0
        ? "It found none of the reviewed objects on held-out frames."
        : others && `On held-out frames it reached a mean IoU of ${iou?.toFixed(2)}, and ${others}.`;
    if (problem && !(await confirm(`Use model ${id} all the same?`, problem, "Use it"))) return;
    await activate(id, `Model ${id}`);
  }

  /** Says that a detector is in use, or lets it be used. */
  const useCell = (/** @type {boolean} */ isUsed, /** @type {string} */ testid, /** @type {() => unknown} */ act) =>
    h("td", isUsed ? h("span.chip.state-accepted", "in use") : button("Use this one", act, { "data-testid": testid }));

  function baseRow(/** @type {"in use" | "available"} */ state) {
    const isUsed = state === "in use";
    const text = "Base detector: trained on generated scenes, not on this project's classes";
    return h(
      "tr",
      { "data-testid": "base-row", "data-active": String(isUsed), class: isUsed ? "active" : "" },
      h("td", ROLES.view),
      h("td.muted", { colspan: COLUMNS.length + 4 }, text),
      useCell(isUsed, "use-base", () => activate("base", "The base detector")),
      h("td"),
    );
  }

  function row(/** @type {Api.ModelDetails} */ model) {
    const { id, role, active, boxes, metrics, box_kind } = model;
    return h(
      "tr",
      {
        "data-testid": "model-row",
        "data-id": id,
        "data-key": id,
        "data-active": String(active),
        class: active ? "active" : "",
      },
      h("td", ROLES[role] ?? role),
      h("td.number", dateOf(model.created_ns / 1e6)),
      h("td.number", boxes === null ? "–" : count(boxes, "box", "boxes")),
      COLUMNS.map(([name]) => h("td.number", metrics[name]?.toFixed(3) ?? "–")),
      h("td.number", { title: comparison(model), "data-testid": "held-out" }, heldOut(model)),
      h("td", box_kind === "box" ? "the whole object" : "the visible part"),
      useCell(active, "use-model", () => use(model)),
      h("td", model.pictures.length ? button("Pictures", () => choose(model), { class: "quiet" }) : null),
    );
  }

  function choose(/** @type {Api.ModelDetails} */ model) {
    shown = model.id;
    showPictures(model);
  }

  function showPictures(/** @type {Api.ModelDetails | undefined} */ model) {
    pictures.hidden = !model?.pictures.length;
    if (!model) return;
    const words = "was not trained on: white boxes are the given ones, coloured ones what it finds.";
    const small = model.pictures.map((url, i) => {
      const label = `Validation picture ${i + 1}`;
      const more = { class: "thumb", title: "Enlarge", "aria-label": label };
      return button(h("img", { src: url, alt: "", loading: "lazy" }), () => enlarge(url, label), more);
    });
    patch(pictures, h("p.muted", `What the ${model.role} detector ${words}`), h("div.row.thumbs-row", small));
  }

  return {
    show(/** @type {Api.ModelList} */ { models, base }) {
      if (models.length === 0 && !base) {
        pictures.hidden = true;
        patch(table, h("p.muted", "No model has been trained yet."));
        return;
      }
      const newest = models.toSorted((a, b) => b.created_ns - a.created_ns);
      const titles = COLUMNS.map(([, text]) => text);
      const heads = [
        "Detector",
        "Trained",
        "Trained on",
        ...titles,
        "Held-out IoU",
        "Boxes enclose",
        "Use",
        "Examples",
      ];
      const head = heads.map((text) =>
        h("th", { scope: "col", title: text === "Held-out IoU" ? HELD_OUT_HELP : null }, text),
      );
      patch(
        table,
        h("table.dense.models", h("thead", h("tr", head)), h("tbody", newest.map(row), base ? baseRow(base) : null)),
        ...Object.keys(ROLES).map((each) =>
          decisionLine(newest.find(({ role, decision }) => role === each && decision)),
        ),
      );
      const pictured = newest.filter((model) => model.pictures.length > 0);
      showPictures(pictured.find(({ id }) => id === shown) ?? pictured.find(({ active }) => active) ?? pictured[0]);
    },
  };
}

function heldOut(/** @type {Api.ModelDetails} */ { decision }) {
  if (!decision || decision.mean_iou === null) return "–";
  return `${decision.mean_iou.toFixed(2)} (${count(decision.objects, "object", "objects")})`;
}

function decisionLine(/** @type {Api.ModelDetails | undefined} */ model) {
  const decision = model?.decision;
  if (!decision) return "";
  const figures = decision.compared.map(({ name, mean_iou }) => `${name} ${mean_iou.toFixed(2)}`);
  if (decision.mean_iou !== null) figures.unshift(`newest detector ${decision.mean_iou.toFixed(2)}`);
  const measured = figures.length ? ` Mean IoU on held-out frames: ${figures.join(", ")}.` : "";
  return h("p.muted", { "data-testid": "decision" }, `Latest ${model.role} detector: ${decision.outcome}.${measured}`);
}

/** What a model was compared with, and the outcome. */
function comparison(/** @type {Api.ModelDetails} */ { decision }) {
  if (!decision) return HELD_OUT_HELP;
  const others = decision.compared.map(({ name, mean_iou }) => `${name} ${mean_iou.toFixed(2)}`);
  return [decision.started_from, ...others, decision.outcome].join("\n");
}

function enlarge(/** @type {string} */ url, /** @type {string} */ label) {
  return openDialog({
    title: label,
    content: [h("img.enlarged", { src: url, alt: `${label} with predicted boxes` })],
    actions: [{ label: "Close", value: "close" }],
    wide: true,
  });
}
