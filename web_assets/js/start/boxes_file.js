/**
 * The dialog that imports boxes from a file: 2D boxes, from which 3D boxes are then proposed, or 3D boxes; and what becomes
 * of their classes that a project does not have: one of its own, a new one, or nothing.
 */

import { newest, projectPath, withQuery } from "../api.js";
import { CANCEL, openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { checkbox, errorBox, field, select } from "../forms.js";

/** The server's limit. */
const MOST_BYTES = 64 * 2 ** 20;
const KINDS = [
  ["silhouette", "the visible part of each object"],
  ["box", "each whole object, hidden parts included"],
];

/** What 3D boxes become. */
const BECOME = [
  ["proposals", "proposals, to be reviewed"],
  ["labels", "labels, on frames without labels and proposals"],
];

/** What measures the 3D boxes of 2D boxes in a project, in words; null: nothing can. */
export const measuredBy = (/** @type {Api.ProjectInfo} */ { detectors }) =>
  detectors.view ? "this project's view detector" : detectors.stand_in;

/**
 * Returns the job that imports the boxes, or null if the dialog was cancelled.
 *
 * @param {App} app
 * @param {string} name the project's name.
 * @returns {Promise<Api.Job | null>}
 */
export async function importBoxes(app, name) {
  const project = await app.api.get(projectPath(name));
  /** Undefined while a file is read. @type {Api.BoxesFile | null | undefined} */
  let sent = null;
  /** The answer to the file that was sent last. @type {Promise<Api.BoxesFile | null>} */
  let upload = Promise.resolve(null);
  const begin = newest();
  const classes = createClassChoice(app, project, false);

  const file = h("input", {
    type: "file",
    accept: ".json,.csv,.zip",
    autofocus: true,
    "data-testid": "boxes-file",
    onchange() {
      upload = send();
      void show();
    },
  });
  const recordings = [["", "any recording"], ...project.recordings.map((one) => [String(one.id), one.name])];
  const recording = select(recordings, { "data-testid": "boxes-recording", onchange: () => show() });
  const kind = select(KINDS, { "data-testid": "boxes-kind" });
  const measure = measuredBy(project);
  const lift = checkbox("boxes-lift", measure !== null, { disabled: measure === null });
  const become = select(BECOME, { "data-testid": "boxes-become", onchange: () => showKind() });
  const source = h("input", { type: "text", maxlength: 200, "data-testid": "boxes-source" });
  const minScore = h("input", { type: "number", step: "any", "data-testid": "boxes-min-score" });
  const scoreHelp = h("span");
  const how = measure === null ? ": this needs a view detector, train one first" : `, measured by: ${measure}`;
  const of2d = h("div.stack", [
    field("The boxes enclose", kind),
    h("label.row", lift, `Propose 3D boxes from them${how}`),
  ]);
  const ofProposals = h("div.stack", [
    field("Source", source, "Whose boxes they are. They replace what this source has proposed before."),
    field("Lowest score", minScore, scoreHelp),
  ]);
  const of3d = h("div.stack", field("The boxes become", become), ofProposals);
  const addAttributes = checkbox("boxes-add-attributes");
  const ofAttributes = h(
    "label.row",
    addAttributes,
    "Add the file's attributes that the project lacks, and give labels the values that they lack",
  );
  const about = h("div.stack", { role: "status", "data-testid": "boxes-about" });

  async function send() {
    const [chosen] = file.files ?? [];
    if (!chosen) return null;
    if (chosen.size > MOST_BYTES)
      throw new Error("The file has more than 64 MiB, the most that a page may send. Divide it.");
    const found = await app.api.post(withQuery(projectPath(name, "boxes-files"), { name: chosen.name }), chosen);
    source.value = found.source;
    return found;
  }

  /** The file, matched with the chosen recording. */
  async function look() {
    const found = await upload;
    if (!found || !recording.value) return found;
    return app.api.get(withQuery(projectPath(name, "boxes-files", found.id), { recording: recording.value }));
  }

  async function show() {
    const isNewest = begin();
    sent = undefined;
    about.replaceChildren("Reading …");
    try {
      const answer = await look();
      if (!isNewest()) return;
      sent = answer;
      about.replaceChildren(...(sent ? described(sent) : []));
    } catch (error) {
      if (!isNewest()) return;
      sent = null;
      about.replaceChildren(errorBox(error));
    }
    classes.show(sent?.boxes ?? {});
    showKind();
  }

  /** Shows what can be chosen for 2D boxes, or for 3D boxes. */
  function showKind() {
    const is3d = sent?.is_3d ?? false;
    ofAttributes.hidden = !sent;
    of2d.hidden = !sent || is3d;
    of3d.hidden = !is3d;
    ofProposals.hidden = become.value !== "proposals";
    const scores = sent?.scores ?? null;
    minScore.disabled = scores === null;
    scoreHelp.textContent = scores
      ? `Boxes with a lower score are left out. The scores are ${number(scores[0])} to ${number(scores[1])}.`
      : "The boxes have no scores.";
  }

  async function start() {
    if (sent === undefined) throw new Error("The file was still being read. Check what it has, then import it.");
    if (!sent) throw new Error("Choose a file with boxes first.");
    if (sent.ambiguous) throw new Error("Choose the recording of the boxes: several have frames of these names.");
    const names = await classes.take();
    return app.api.post(projectPath(name, "jobs"), {
      kind: "boxes",
      upload: sent.id,
      names,
      recording: recording.value ? Number(recording.value) : null,
      add_attributes: addAttributes.checked,
      ...(sent.is_3d
        ? {
            become: become.value,
            source: source.value.trim() || null,
            min_score: become.value === "proposals" && minScore.value ? Number(minScore.value) : null,
          }
        : { box_kind: kind.value, lift: lift.checked }),
    });
  }

  showKind();
  return openDialog({
    title: `Import boxes into ${name}`,
    testid: "boxes-dialog",
    wide: true,
    content: [
      field(
        "File",
        file,
        "2D boxes on camera images: a COCO file (.json), or a YOLO or COCO folder packed as .zip. 3D boxes: " +
          "boxes.json, OpenLABEL, nuScenes' results, a CSV file of upright boxes, or a folder such as KITTI's " +
          "label_2 packed as .zip. Images and frames must have the names of the project's, such as 000012.",
      ),
      about,
      classes.root,
      project.recordings.length > 1 && field("The boxes are of", recording),
      of2d,
      of3d,
      ofAttributes,
    ],
    actions: [CANCEL, { label: "Import", value: "import" }],
    submit: start,
  });
}

/** A score with few digits. */
const number = (/** @type {number} */ value) => Number(value.toPrecision(3)).toString();

/** What a file has. */
function described(/** @type {Api.BoxesFile} */ { name, found, notes, ambiguous, is_3d }) {
  const things = count(ambiguous, is_3d ? "frame" : "image");
  return [
    h("p", { "data-testid": "boxes-found" }, `${name}: ${found}`),
    ...notes.map((note) => h("p", { "data-testid": "boxes-note" }, note)),
    ...(ambiguous ? [errorBox(`${things} could be of several recordings. Choose the recording below.`)] : []),
  ];
}

// -- the classes

/** Values of a choice beside the project's classes; these have at least one character. */
const LEAVE_OUT = "";
const ADD = "\n";

/** What spellings of a class differ in is left out: case, spaces, `-` and `_`. */
const folded = (/** @type {string} */ name) => name.toLowerCase().replace(/[ _-]/g, "");

/**
 * The choices for the classes of boxes; those that the project has by the same name need none.
 *
 * @param {App} app
 * @param {Api.ProjectInfo} project
 * @param {boolean} areAdded whether a class is added, if nothing else is chosen.
 */
export function createClassChoice(app, { name, classes }, areAdded) {
  /** @type {Map<string, HTMLSelectElement>} */
  const choices = new Map();
  /** @type {string[]} */
  let labels = [];
  const root = h("fieldset.choices", { hidden: true, "data-testid": "boxes-classes" });

  function choice(/** @type {string} */ label) {
    const known = classes.map((each) => [each, `are ${each}`]);
    const alike = classes.find((each) => folded(each) === folded(label));
    return select(
      [[LEAVE_OUT, "leave out"], ...known, [ADD, `add the class ${label}`]],
      { "aria-label": `Class for ${label}`, "data-testid": `boxes-class-${label}` },
      alike ?? (areAdded ? ADD : LEAVE_OUT),
    );
  }

  return {
    root,
    /** Asks about the classes of some boxes, with the number of each. */
    show(/** @type {Record<string, number>} */ boxes) {
      labels = Object.keys(boxes);
      const unknown = labels.filter((label) => !classes.includes(label));
      root.hidden = unknown.length === 0;
      for (const label of unknown) if (!choices.has(label)) choices.set(label, choice(label));
      root.replaceChildren(
        h("legend.field-label", "Classes that the project does not have"),
        ...unknown.map((label) =>
          h("label.row", h("span.grow.ellipsis", `${label} (${count(boxes[label], "box")})`), choices.get(label)),
        ),
      );
    },
    /** Adds classes as chosen. Returns the project's class of each other name; "" leaves its boxes out. */
    async take() {
      const values = labels.map((label) => /** @type {const} */ ([label, choices.get(label)?.value ?? label]));
      if (labels.length && values.every(([, value]) => value === LEAVE_OUT))
        throw new Error("All classes are left out. Choose one of the project's.");
      const wanted = values.flatMap(([label, value]) => (value === ADD ? [label] : []));
      if (wanted.length) {
        // an earlier try may have added some
        const present = await app.api.get(projectPath(name));
        const added = wanted.filter((label) => !present.classes.includes(label));
        if (added.length) await app.api.patch(projectPath(name), { classes: [...present.classes, ...added] });
      }
      const named = values.map(([label, value]) => [label, value === ADD ? label : value]);
      return Object.fromEntries(named.filter(([label, value]) => label !== value || wanted.includes(label)));
    },
  };
}

/**
 * Asks about the classes that an import of recorded boxes left out. Returns the job that imports these boxes, or null.
 *
 * @returns {Promise<Api.Job | null>}
 */
export async function importLeftOut(/** @type {App} */ app, /** @type {Api.Job} */ { project, result }) {
  const { unknown, recordings } = /** @type {ImportResult} */ (result);
  const choice = createClassChoice(app, await app.api.get(projectPath(project)), true);
  choice.show(unknown);
  return openDialog({
    title: "Classes of the boxes that were left out",
    testid: "left-out-dialog",
    content: [choice.root],
    actions: [CANCEL, { label: "Import", value: "import" }],
    async submit() {
      const names = await choice.take();
      return app.api.post(projectPath(project, "jobs"), { kind: "import", recordings, names });
    },
  });
}
