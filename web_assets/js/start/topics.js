/** The topics of a bag that is to be added: chosen by the server where that is clear, else by the operator. */

import { newest, withQuery } from "../api.js";
import { CANCEL, openDialog } from "../dialogs.js";
import { count, h, patch } from "../dom.js";
import { errorBox, select } from "../forms.js";

/**
 * What can be chosen: its parameter, its name, the options of the topics that can be named, and what a topic is used as.
 *
 * @type {[string, string, string[], string[]][]}
 */
const CHOICES = [
  ["image", "Images", ["--image"], ["image"]],
  ["points", "Points or depth", ["--points", "--depth"], ["points", "depth"]],
  ["camera_info", "Calibration", ["--camera-info"], ["camera"]],
  ["depth_info", "Depth calibration", ["--depth-info", "--camera-info"], ["camera of the depth"]],
];

/**
 * Shows the topics with a preview of the first frame. Returns the reader's options, or null if it was cancelled.
 *
 * @returns {Promise<Record<string, string> | null>}
 */
export async function chooseTopics(/** @type {App} */ app, /** @type {Api.FolderEntry} */ entry) {
  /** What the operator has chosen; the other topics are left to the server. @type {Record<string, string>} */
  const named = {};
  const rows = h("div.stack");
  const preview = h("figure.bag-preview", { role: "status" });
  /** @type {Api.BagPreview | null} */
  let bag = null;
  const begin = newest();

  async function show() {
    const isNewest = begin();
    patch(preview, h("figcaption.muted", "Reading the first frame …"));
    try {
      const answer = await app.api.get(withQuery("/api/bags", { path: entry.path, ...named }));
      if (!isNewest()) return;
      bag = answer;
      patch(
        rows,
        CHOICES.map((choice) => row(choice, answer.topics)),
      );
      patch(preview, describe(answer));
    } catch (error) {
      if (isNewest()) patch(preview, errorBox(error));
    }
  }

  function row(
    /** @type {(typeof CHOICES)[number]} */ [id, label, options, uses],
    /** @type {Api.TopicReport[]} */ topics,
  ) {
    if (id === "depth_info" && !topics.some(({ option }) => option === "--depth")) return null;
    const candidates = topics.filter(({ option }) => options.includes(option));
    // a topic of depth is another option of the reader
    const parameters = id === "points" ? ["points", "depth"] : [id];
    const chosen = candidates.find(({ name }) => parameters.some((parameter) => named[parameter] === name));
    const used = candidates.find(({ use }) => uses.includes(use));
    const automatic = used && !chosen ? `${used.name} (chosen automatically)` : "choose automatically";
    const onchange = (/** @type {Event} */ { currentTarget }) => {
      const { value } = /** @type {HTMLSelectElement} */ (currentTarget);
      const isDepth = candidates.some(({ name, option }) => name === value && option === "--depth");
      for (const parameter of parameters) delete named[parameter];
      if (value) named[isDepth ? "depth" : id] = value;
      void show();
    };
    const all = [["", automatic], ...candidates.map((topic) => [topic.name, nameOf(topic)])];
    return h("label.row.bag-topic", [
      h("span", label),
      select(all, { "data-testid": `topic-${id}`, onchange }, chosen?.name),
    ]);
  }

  void show();
  return openDialog({
    title: `Topics of ${entry.name}`,
    testid: "topics-dialog",
    wide: true,
    content: [rows, preview],
    actions: [CANCEL, { label: "Add", value: "add" }],
    submit() {
      if (!bag?.frames) throw new Error("Please choose topics that can be read first.");
      return named;
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
      (message, [, label, options]) =>
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
