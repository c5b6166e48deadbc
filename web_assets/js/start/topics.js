/** The topics of a bag that is to be added: chosen by the server where that is clear, else by the operator. */

import { newest, withQuery } from "../api.js";
import { CANCEL, openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { errorBox } from "../forms.js";

/**
 * What can be chosen: its name, the options of the topics that can be named, and what a topic is used as.
 *
 * @type {{ id: string, label: string, options: string[], uses: string[] }[]}
 */
const CHOICES = [
  { id: "image", label: "Images", options: ["--image"], uses: ["image"] },
  { id: "points", label: "Points or depth", options: ["--points", "--depth"], uses: ["points", "depth"] },
  { id: "camera_info", label: "Calibration", options: ["--camera-info"], uses: ["camera"] },
  {
    id: "depth_info",
    label: "Depth calibration",
    options: ["--depth-info", "--camera-info"],
    uses: ["camera of the depth"],
  },
];

/**
 * Shows the topics with a preview of the first frame. Returns the reader's options, or null if it was cancelled.
 *
 * @returns {Promise<Record<string, string> | null>}
 */
export async function chooseTopics(/** @type {App} */ app, /** @type {Api.FolderEntry} */ entry) {
  const selects = CHOICES.map(({ id }) => h("select", { "data-testid": `topic-${id}`, onchange: () => void show() }));
  const rows = CHOICES.map(({ label }, index) => h("label.row.bag-topic", h("span", label), selects[index]));
  const preview = h("figure.bag-preview", { role: "status" });
  /** @type {Api.BagPreview | null} */
  let bag = null;
  const begin = newest();

  /** The options that the operator has chosen; what is not chosen is left to the server. */
  function options() {
    /** @type {Record<string, string>} */
    const chosen = {};
    for (const [index, { id }] of CHOICES.entries()) {
      const name = selects[index].value;
      const isDepth = bag?.topics.some((topic) => topic.name === name && topic.option === "--depth");
      if (name) chosen[id === "points" && isDepth ? "depth" : id] = name;
    }
    return chosen;
  }

  async function show() {
    const chosen = options();
    const isNewest = begin();
    preview.replaceChildren(h("figcaption.muted", "Reading the first frame …"));
    try {
      const answer = await app.api.get(withQuery("/api/bags", { path: entry.path, ...chosen }));
      if (!isNewest()) return;
      bag = answer;
      fill(answer, chosen);
      preview.replaceChildren(...describe(answer));
    } catch (error) {
      if (isNewest()) preview.replaceChildren(errorBox(error));
    }
  }

  /**
   * @param {Api.BagPreview} answer
   * @param {Record<string, string>} named the topics that the operator has chosen.
   */
  function fill({ topics }, named) {
    for (const [index, { id, options: flags, uses }] of CHOICES.entries()) {
      const candidates = topics.filter(({ option }) => flags.includes(option));
      const used = candidates.find(({ use }) => uses.includes(use));
      const chosen = candidates.find(({ name }) => name === (named[id] ?? (id === "points" ? named.depth : "")));
      if (id === "depth_info") rows[index].hidden = !topics.some(({ option }) => option === "--depth");
      const automatic = used && !chosen ? `${used.name} (chosen automatically)` : "choose automatically";
      selects[index].replaceChildren(
        h("option", { value: "" }, automatic),
        ...candidates.map((topic) => h("option", { value: topic.name }, nameOf(topic))),
      );
      selects[index].value = chosen?.name ?? "";
    }
  }

  void show();
  return openDialog({
    title: `Topics of ${entry.name}`,
    testid: "topics-dialog",
    wide: true,
    content: [...rows, preview],
    actions: [CANCEL, { label: "Add", value: "add" }],
    submit() {
      if (!bag?.frames) throw new Error("Please choose topics that can be read first.");
      return options();
    },
  });
}

function nameOf(/** @type {Api.TopicReport} */ { name, type, messages, rate_hz }) {
  const rate = rate_hz === null ? "" : `, ${rate_hz.toPrecision(3)} Hz`;
  return `${name} (${type}, ${count(messages, "message")}${rate})`;
}

function describe(/** @type {Api.BagPreview} */ { frames, notes, problem, picture }) {
  if (problem) {
    // the message names the options of the command line
    const text = CHOICES.reduce(
      (message, { label, options }) =>
        options.reduce((one, flag) => one.replace(new RegExp(`${flag}(?!-)`, "g"), label), message),
      problem,
    );
    return [errorBox(text, "topics-problem")];
  }
  return [
    h("img", { src: picture, alt: "The first frame with its points, near ones red", "data-testid": "topics-preview" }),
    h("figcaption", `${count(frames, "frame")}. The first one, with its points: near ones red, far ones blue.`),
    ...notes.map((note) => h("p.help", note)),
  ];
}
