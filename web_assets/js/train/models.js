/** The models that were trained: what each learned from, how good it was, which one proposes, and what it sees. */

import { openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";

const ROLES = { image: "Image", view: "View" };
const COLUMNS = [["map50", "mAP 50"], ["map50_95", "mAP 50–95"], ["precision", "Precision"], ["recall", "Recall"]];

export function createModelList(host, app, reload) {
  const pictures = h("div", { class: "thumbs", "data-testid": "validation-pictures" });
  const table = h("div", { class: "scroll-x" });
  const body = h("div", { class: "body stack" }, pictures, table);
  host.append(h("header", {}, h("h2", {}, "Models")), body);
  let shown = null;

  async function use(model) {
    try {
      await app.api.post(app.path("models", model.id, "activate"));
      app.toast(`Model ${model.id} proposes from now on.`, "good");
      await reload();
    } catch (error) {
      app.toast(error);
    }
  }

  function row(model) {
    const made = new Date(model.created_ns / 1e6);
    return h(
      "tr",
      { "data-testid": "model-row", "data-id": model.id, "data-active": String(model.active), class: model.active ? "active" : "" },
      h("td", {}, ROLES[model.role] ?? model.role),
      h("td", { class: "number" }, made.toLocaleString([], { dateStyle: "medium", timeStyle: "short" })),
      h("td", { class: "number" }, model.boxes === null ? "–" : count(model.boxes, "box", "boxes")),
      COLUMNS.map(([name]) => h("td", { class: "number" }, model.metrics[name] === undefined || model.metrics[name] === null ? "–" : model.metrics[name].toFixed(3))),
      h("td", {}, model.box_kind === "box" ? "whole boxes" : "what is seen"),
      h("td", {}, model.active ? h("span", { class: "chip state-accepted" }, "in use") : h("button", { type: "button", "data-testid": "use-model", onclick: () => use(model) }, "Use this one")),
      h("td", {}, model.pictures.length ? h("button", { type: "button", class: "quiet", onclick: () => ((shown = model.id), showPictures(model)) }, "Pictures") : null),
    );
  }

  function showPictures(model) {
    pictures.hidden = !model || model.pictures.length === 0;
    if (pictures.hidden) return;
    pictures.replaceChildren(
      h("p", { class: "muted" }, `Validation pictures of the ${ROLES[model.role].toLowerCase()} detector, with the boxes that it finds on them. It has not learned from these.`),
      h("div", { class: "row thumbs-row" }, model.pictures.map((url, i) => h("button", { type: "button", class: "thumb", title: "Enlarge", "aria-label": `Validation picture ${i + 1}`, onclick: () => enlarge(url, i) }, h("img", { src: url, alt: "", loading: "lazy" })))),
    );
  }

  return {
    show(models) {
      if (models.length === 0) {
        pictures.hidden = true;
        table.replaceChildren(h("p", { class: "muted" }, "No model has been trained yet."));
        return;
      }
      const newest = models.toSorted((a, b) => b.created_ns - a.created_ns);
      const heads = ["Detector", "Trained", "Learned from", ...COLUMNS.map(([, text]) => text), "Its boxes are", "", ""];
      table.replaceChildren(h("table", { class: "dense models" }, h("thead", {}, h("tr", {}, heads.map((text) => h("th", { scope: "col" }, text)))), h("tbody", {}, newest.map(row))));
      const active = newest.filter((model) => model.active && model.pictures.length > 0);
      showPictures(newest.find((model) => model.id === shown) ?? active.find(({ role }) => role === "view") ?? active[0]);
    },
  };
}

function enlarge(url, i) {
  return openDialog({ title: `Validation picture ${i + 1}`, content: [h("img", { src: url, alt: `Validation picture ${i + 1} with predicted boxes`, class: "enlarged" })], actions: [{ label: "Close", value: "close" }], wide: true });
}
