/** Which way is up: known from the files, proposed, or turned by hand. */

import { button, count, h } from "../dom.js";
import { dot, multiply, transpose } from "../rotation.js";
import { anglesOf, upOf } from "./level.js";
import { createSlider, panel, SAME } from "./panel.js";
import { rotationOf } from "./picture.js";

/** The up direction of a camera that is level, which is shown while none is known. */
const LEVEL = upOf({ roll: 0, pitch: 0 });

/** What the project's setting of rotation says of its boxes. @type {Record<string, string>} */
const ROTATIONS = {
  auto: "upright where up is known, else of any rotation",
  upright: "upright",
  free: "of any rotation",
};

/**
 * @param {{ rotation: () => unknown, onChange: () => void, onPropose: () => unknown, onDiscard: () => void,
 *     onKeep: (up: Vector | null) => unknown }} options `rotation`: the project's setting.
 */
export function createLevelPanel({ rotation, onChange, onPropose, onDiscard, onKeep }) {
  /** @type {Api.AlignmentJson | null} */
  let known = null;
  /** The up direction that is shown, relative to the stored correction; null: unknown. @type {Vector | null} */
  let up = null;
  /** @type {Api.EstimatedUp | null} */
  let estimate = null;

  const roll = createSlider({ label: "Roll", testid: "roll", most: 60, step: 0.1, unit: "°", onChange: turn });
  const pitch = createSlider({ label: "Pitch", testid: "pitch", most: 90, step: 0.1, unit: "°", onChange: turn });
  const source = h("p", { role: "status", "data-testid": "up-source" });
  const propose = button("Propose", onPropose, { "data-testid": "estimate-up" });
  const accept = button("Keep this level", () => onKeep(up ?? LEVEL), { "data-testid": "keep-up" });
  const refuse = button("Discard", onDiscard, { "data-testid": "refuse-up" });
  const unknown = button("As in the files", () => onKeep(null), { "data-testid": "clear-up" });
  unknown.title = "Take it from the recording's files again; if they do not tell, it is unknown";
  const follows = h("p.help", { "data-testid": "up-effect" });

  function turn() {
    estimate = null;
    up = upOf({ roll: roll.value, pitch: pitch.value });
    onChange();
  }

  function set(/** @type {Vector | null} */ next) {
    up = next;
    const { roll: rolled, pitch: pitched } = anglesOf(next ?? LEVEL);
    roll.set(rolled);
    pitch.set(pitched);
  }

  function isChanged() {
    if (known === null || up === null) return false;
    return known.up === null || dot(up, known.up) < 1 - SAME;
  }

  function described() {
    if (known === null) return "";
    if (estimate !== null && estimate.up === null) return `No proposal: ${estimate.reason}.`;
    if (estimate !== null) {
      const isSet = isChanged() ? "" : " It is set already.";
      const spread = estimate.spread_deg.toFixed(1);
      return (
        `Proposed with certainty ${estimate.certainty.toFixed(2)}: ${estimate.reason}; ` +
        `${estimate.agreeing} of ${count(estimate.frames, "frame")} agree within ${spread}°.${isSet}`
      );
    }
    if (isChanged()) return "Turned by hand, not kept yet (dashed).";
    const words = {
      unknown:
        "Not known: boxes may have any rotation. Propose a level, turn one by hand, or keep that of a level camera " +
        "(dashed).",
      files: "Known from the recording's files.",
      project: "Set in this project.",
    };
    return words[known.up_source];
  }

  return {
    root: panel("Which way is up", [source, roll.root, pitch.root], [propose, accept, refuse, unknown], follows),
    isChanged,
    /** The shown level is the stored one. */
    isKept: () => known !== null && known.up !== null && !isChanged(),
    /** Turned by hand and not kept. */
    isUnsaved: () => estimate === null && isChanged(),
    /** The shown level if it is not the stored one, otherwise null. */
    changed: () => (isChanged() ? up : null),
    get estimate() {
      return estimate;
    },
    /** The shown level in the camera frame of a correction. */
    turned(/** @type {Api.CorrectionJson} */ after) {
      if (known === null) return null;
      const change = multiply(rotationOf(after.turn_deg), transpose(rotationOf(known.correction.turn_deg)));
      const shown = up ?? LEVEL;
      return change.map((row) => dot(row, shown));
    },
    /** Shows what is stored. */
    take(/** @type {Api.AlignmentJson} */ answer) {
      known = answer;
      estimate = null;
      set(known.up);
    },
    /**
     * Shows a proposal or a level that was not kept yet.
     *
     * @param {Vector | null} level null: the one that is shown.
     * @param {Api.EstimatedUp | null} proposed
     */
    put(level, proposed) {
      estimate = proposed;
      if (level !== null) set(level);
    },
    /** Says that a proposal is being made. */
    wait() {
      source.textContent = "Looking at some frames …";
    },
    /**
     * @param {boolean} isOff nothing can be kept now.
     * @param {boolean} isBusy
     */
    show(isOff, isBusy) {
      // an unknown level can be kept as it is shown: there may be nothing to turn
      accept.disabled = isOff || known === null || !(isChanged() || known.up === null);
      refuse.disabled = isOff || (estimate === null && !isChanged());
      unknown.disabled = isOff || known?.up_source !== "project";
      propose.disabled = isBusy;
      source.textContent = described();
      follows.textContent =
        "Stored boxes do not change; new ones, views and proposals follow. " +
        `The boxes of this project are ${ROTATIONS[String(rotation())]}.`;
    },
  };
}
