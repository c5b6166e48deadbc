/** What is beside the picture: the sliders of the correction and of the level, what they mean, and what is done with them. */

import { button, count, h, patch } from "../dom.js";
import { numberField } from "../forms.js";
import { upOf } from "./level.js";
import { correctionOf, isCorrected, isTurned, levelOf, NONE, numbersOf, withNumber } from "./setting.js";

const [DEGREES, METRES, SECONDS] = [
  { most: 5, step: 0.01, unit: "°" },
  { most: 0.5, step: 0.001, unit: "m" },
  { most: 1, step: 0.01, unit: "s" },
];
/** A slider for each number of a correction: its test id, its name and its range. @type {[string, string, Range][]} */
const MOVES = [
  ["turn-x", "Turn about x (right)", DEGREES],
  ["turn-y", "Turn about y (down)", DEGREES],
  ["turn-z", "Turn about z (ahead)", DEGREES],
  ["shift-x", "Shift along x (right)", METRES],
  ["shift-y", "Shift along y (down)", METRES],
  ["shift-z", "Shift along z (ahead)", METRES],
  ["time-offset", "Clouds' clock ahead", SECONDS],
];
/** @type {[keyof import("./setting.js").Level, string, Range][]} */
const ANGLES = [
  ["roll", "Roll", { most: 60, step: 0.1, unit: "°" }],
  ["pitch", "Pitch", { most: 90, step: 0.1, unit: "°" }],
];
const UP_SOURCES = {
  unknown:
    "Not known: boxes may have any rotation. Propose a level, turn one by hand, or keep that of a level camera (dashed).",
  files: "Known from the recording's files.",
  project: "Set in this project.",
};
/** What the project's setting of rotation says of its boxes. @type {Record<string, string>} */
const ROTATIONS = {
  auto: "upright where up is known, else of any rotation",
  upright: "upright",
  free: "of any rotation",
};

/**
 * `most`: the slider's greatest value, and minus its least one; the field beside it takes any number.
 *
 * @typedef {{ most: number, step: number, unit: string }} Range
 * @typedef {import("./setting.js").Setting} Setting
 * @typedef {"keeping" | "proposing" | null} Busy
 */

/**
 * @param {object} options
 * @param {() => unknown} options.rotation the project's setting.
 * @param {(changes: Partial<Setting>) => unknown} options.change
 * @param {() => unknown} options.propose
 * @param {(content: { correction: Api.CorrectionJson } | { up: Vector | null }) => unknown} options.keep
 * @param {() => unknown} options.discard
 */
export function createControls({ rotation, change, propose, keep, discard }) {
  const root = h("div.aside");

  function calibration(/** @type {Setting} */ setting, /** @type {boolean} */ isOff) {
    const { correction: stored, images, labels, name, drawn_images: drawn, is_virtual: isVirtual } = setting.stored;
    const correction = correctionOf(setting);
    const isStored = { disabled: isOff || !isCorrected(setting) };
    const isNone = numbersOf(stored).every((number) => number === 0);
    const remove = button("Remove the correction", () => keep({ correction: NONE }), {
      disabled: isOff || isNone,
      "data-testid": "clear-correction",
    });
    if (isVirtual) {
      const text = "The image is drawn from the cloud itself, so there is no calibration to correct.";
      return panel("Calibration", [], isNone ? [] : [remove], text, "correction-effect");
    }
    const sliders = numbersOf(correction).map((number, i) =>
      slider(...MOVES[i], number, (value) => change({ correction: withNumber(correction, i, value) })),
    );
    if (images.length === 0)
      sliders.splice(-1, 1, h("p.help", "The frames have no times, so there is no time offset to correct."));
    const elsewhere =
      `${count(drawn, "frame has", "frames have")} boxes that were drawn on the image. With this time offset ` +
      "they are on another image: draw them again.";
    const hasElsewhere = drawn > 0 && correction.time_offset_s !== stored.time_offset_s;
    return panel(
      "Calibration",
      [...sliders, hasElsewhere && h("p.bad", { "data-testid": "offset-note" }, elsewhere)],
      [
        button("Keep this correction", () => keep({ correction }), { ...isStored, "data-testid": "keep-correction" }),
        button("Discard changes", discard, { ...isStored, "data-testid": "discard-correction" }),
        remove,
      ],
      `Holds for all frames of ${name}. ${count(labels, "3D box stays", "3D boxes stay")} in the cloud, and on the image ` +
        "they move with it. 2D boxes drawn on images stay there. Undo restores everything.",
      "correction-effect",
    );
  }

  function upDirection(/** @type {Setting} */ setting, /** @type {boolean} */ isOff, /** @type {Busy} */ busy) {
    const { stored, proposed } = setting;
    const level = levelOf(setting);
    const isOther = isTurned(setting);
    const sliders = ANGLES.map(([angle, label, range]) =>
      slider(angle, label, range, level[angle], (value) =>
        change({ level: { ...level, [angle]: value }, proposed: null }),
      ),
    );
    const text = busy === "proposing" ? "Looking at some frames …" : levelText(setting);
    return panel(
      "Which way is up",
      [h("p", { role: "status", "data-testid": "up-source" }, text), ...sliders],
      [
        button("Propose", propose, { disabled: busy !== null, "data-testid": "estimate-up" }),
        button("Keep this level", () => keep({ up: upOf(level) }), {
          // an unknown level can be kept as it is shown: there may be nothing to turn
          disabled: isOff || !(isOther || stored.up === null),
          "data-testid": "keep-up",
        }),
        button("Discard", discard, {
          disabled: isOff || !(isOther || proposed !== null),
          "data-testid": "refuse-up",
        }),
        button("As in the files", () => keep({ up: null }), {
          disabled: isOff || stored.up_source !== "project",
          title: "Take it from the recording's files again; if they do not tell, it is unknown",
          "data-testid": "clear-up",
        }),
      ],
      "Stored boxes do not change; new ones, views and proposals follow. " +
        `The boxes of this project are ${ROTATIONS[String(rotation())]}.`,
      "up-effect",
    );
  }

  return {
    root,
    /** Shows a setting. Nothing can be kept while something is being done, or in a frame that cannot be read. */
    show(/** @type {Setting} */ setting, /** @type {Busy} */ busy, /** @type {boolean} */ isBroken) {
      const isOff = isBroken || busy !== null;
      patch(root, calibration(setting, isOff), upDirection(setting, isOff, busy));
    },
  };
}

/** Where the level that is shown comes from. */
function levelText(/** @type {Setting} */ setting) {
  const { stored, proposed } = setting;
  if (proposed !== null && proposed.up === null) return `No proposal: ${proposed.reason}.`;
  if (proposed !== null)
    return (
      `Proposed with certainty ${proposed.certainty.toFixed(2)}: ${proposed.reason}; ${proposed.agreeing} of ` +
      `${count(proposed.frames, "frame")} agree within ${proposed.spread_deg.toFixed(1)}°.` +
      (isTurned(setting) ? "" : " It is set already.")
    );
  return isTurned(setting) ? "Turned by hand, not kept yet (dashed)." : UP_SOURCES[stored.up_source];
}

const panel = (
  /** @type {string} */ title,
  /** @type {Child[]} */ parts,
  /** @type {HTMLElement[]} */ buttons,
  /** @type {string} */ effect,
  /** @type {string} */ testid,
) =>
  h("section.panel", [
    h("header", h("h2", title)),
    h("div.body.stack", parts, h("div.row.wrap", buttons), h("p.help", { "data-testid": testid }, effect)),
  ]);

/**
 * A slider with a field for its number; both change together.
 *
 * @param {string} testid
 * @param {string} label
 * @param {Range} range
 * @param {number} value
 * @param {(value: number) => unknown} change
 */
function slider(testid, label, { most, step, unit }, value, change) {
  const oninput = (/** @type {Event} */ { currentTarget }) => {
    const { valueAsNumber: next } = /** @type {HTMLInputElement} */ (currentTarget);
    if (Number.isFinite(next)) change(next);
  };
  const limits = { type: "range", min: -most, max: most, step };
  const field = numberField(`${testid}-field`, `${label}, ${unit}`, { class: "number", step, oninput });
  // what is being typed stays as long as it is this number
  const typed = document.activeElement;
  const isTyped = typed instanceof HTMLInputElement && typed.dataset.testid === field.dataset.testid;
  field.value = isTyped && typed.valueAsNumber === value ? typed.value : value.toFixed(Math.round(-Math.log10(step)));
  return h("div.slider", [
    h("span", label),
    h("input", { ...limits, value, "aria-label": label, "data-testid": testid, oninput }),
    field,
    h("span.muted", unit),
  ]);
}
