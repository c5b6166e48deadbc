/** The trained models: training data, quality, which one is in use, and validation pictures. */

import { openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";

const ROLES = { image: "Image", view: "View" };
const COLUMNS = [
  ["map50", "mAP50"],
  ["map50_95", "mAP50-95"],
  ["precision", "Precision"],
  ["recall", "Recall"],
];

/**
 * @param {HTMLElement} host
 * @param {App} app
 * @param {() => Promise<void>} reload
 */
export function createModelList(host, app, reload) {
  const pictures = h("div", { class: "thumbs", "data-testid": "validation-pictures" });
  const table = h("div", { class: "scroll-x" });
  const note = h("p", { hidden: true, "data-testid": "view-detector-in-use" });
  const body = h("div", { class: "body stack" }, note, pictures, table);
  host.append(h("header", {}, h("h2", {}, "Models")), body);
  /** @type {number | null} */
  let shown = null;

  /** @param {Api.ModelDetails} model */
  async function use(model) {
    try {
      await app.api.post(app.path("models", model.id, "activate"));
      app.toast(`Model ${model.id} is in use now.`, "good");
      await reload();
    } catch (error) {
      app.toast(error);
    }
  }

  /** @param {Api.ModelDetails} model */
  function row(model) {
    const made = new Date(model.created_ns / 1e6);
    return h(
      "tr",
      {
        "data-testid": "model-row",
        "data-id": model.id,
        "data-active": String(model.active),
        class: model.active ? "active" : "",
      },
      h("td", {}, ROLES[model.role] ?? model.role),
      h("td", { class: "number" }, made.toLocaleString([], { dateStyle: "medium", timeStyle: "short" })),
      h("td", { class: "number" }, model.boxes === null ? "–" : count(model.boxes, "box", "boxes")),
      COLUMNS.map(([name]) =>
        h(
          "td",
          { class: "number" },
          model.metrics[name] === undefined || model.metrics[name] === null ? "–" : model.metrics[name].toFixed(3),
        ),
      ),
      h("td", {}, model.box_kind === "box" ? "the whole object" : "the visible part"),
      h(
        "td",
        {},
        model.active
          ? h("span", { class: "chip state-accepted" }, "in use")
          : h("button", { type: "button", "data-testid": "use-model", onclick: () => use(model) }, "Use this one"),
      ),
      h(
        "td",
        {},
        model.pictures.length
          ? h("button", { type: "button", class: "quiet", onclick: () => choose(model) }, "Pictures")
          : null,
      ),
    );
  }

  /** @param {Api.ModelDetails} model */
  function choose(model) {
    shown = model.id;
    showPictures(model);
  }

  /** @param {Api.ModelDetails | undefined} model */
  function showPictures(model) {
    const isHidden = !model || model.pictures.length === 0;
    pictures.hidden = isHidden;
    if (isHidden) return;
    pictures.replaceChildren(
      h(
        "p",
        { class: "muted" },
        `Pictures that the ${model.role} detector was not trained on, with the boxes that it finds.`,
      ),
      h(
        "div",
        { class: "row thumbs-row" },
        model.pictures.map((url, i) =>
          h(
            "button",
            {
              type: "button",
              class: "thumb",
              title: "Enlarge",
              "aria-label": `Validation picture ${i + 1}`,
              onclick: () => enlarge(url, i),
            },
            h("img", { src: url, alt: "", loading: "lazy" }),
          ),
        ),
      ),
    );
  }

  return {
    /**
     * @param {Api.ModelDetails[]} models
     * @param {string | null | undefined} standIn the detector that is used while there is no view detector.
     */
    show(models, standIn) {
      const inUse = standIn ? `View detector in use: ${standIn}.` : "";
      note.textContent = inUse;
      note.hidden = !inUse;
      if (models.length === 0) {
        pictures.hidden = true;
        table.replaceChildren(h("p", { class: "muted" }, "No model has been trained yet."));
        return;
      }
      const newest = models.toSorted((a, b) => b.created_ns - a.created_ns);
      const heads = ["Detector", "Trained", "Trained on", ...COLUMNS.map(([, text]) => text), "Boxes enclose", "", ""];
      table.replaceChildren(
        h(
          "table",
          { class: "dense models" },
          h(
            "thead",
            {},
            h(
              "tr",
              {},
              heads.map((text) => h("th", { scope: "col" }, text)),
            ),
          ),
          h("tbody", {}, newest.map(row)),
        ),
      );
      const active = newest.filter((model) => model.active && model.pictures.length > 0);
      showPictures(
        newest.find((model) => model.id === shown) ?? active.find(({ role }) => role === "view") ?? active[0],
      );
    },
  };
}

/**
 * @param {string} url
 * @param {number} i
 */
function enlarge(url, i) {
  return openDialog({
    title: `Validation picture ${i + 1}`,
    content: [h("img", { src: url, alt: `Validation picture ${i + 1} with predicted boxes`, class: "enlarged" })],
    actions: [{ label: "Close", value: "close" }],
    wide: true,
  });
}
