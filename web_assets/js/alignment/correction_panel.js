/** How the cloud lies on the image: its turn and shift to the camera, and its time offset. */

import { button, count, h } from "../dom.js";
import { createSlider, panel, SAME } from "./panel.js";

const AXES = [
  ["x", "right"],
  ["y", "down"],
  ["z", "ahead"],
];

/** @type {Api.CorrectionJson} */
const NONE = { turn_deg: [0, 0, 0], shift_m: [0, 0, 0], time_offset_s: 0 };

/** @param {{ onChange: () => void, onKeep: (value: Api.CorrectionJson) => unknown, onDiscard: () => void }} options */
export function createCorrectionPanel({ onChange, onKeep, onDiscard }) {
  /** @type {Api.AlignmentJson | null} */
  let known = null;

  const degrees = { most: 5, step: 0.01, unit: "°", onChange };
  const metres = { most: 0.5, step: 0.001, unit: "m", onChange };
  const seconds = { most: 1, step: 0.01, unit: "s", onChange };
  const turns = AXES.map(([axis, where]) =>
    createSlider({ label: `Turn about ${axis} (${where})`, testid: `turn-${axis}`, ...degrees }),
  );
  const shifts = AXES.map(([axis, where]) =>
    createSlider({ label: `Shift along ${axis} (${where})`, testid: `shift-${axis}`, ...metres }),
  );
  const offset = createSlider({ label: "Clouds' clock ahead", testid: "time-offset", ...seconds });
  const noTimes = h("p.help", "The frames have no times, so there is no time offset to correct.");
  const offsetNote = h("p.bad", { hidden: true, "data-testid": "offset-note" });
  const keep = button("Keep this correction", () => onKeep(value()), { "data-testid": "keep-correction" });
  const back = button("Discard changes", onDiscard, { "data-testid": "discard-correction" });
  const zero = button("Remove the correction", () => onKeep(NONE), { "data-testid": "clear-correction" });
  const effect = h("p.help", { "data-testid": "correction-effect" });

  /** @returns {Api.CorrectionJson} */
  function value() {
    const [x, y, z] = turns.map((each) => each.value);
    const [right, down, ahead] = shifts.map((each) => each.value);
    return { turn_deg: [x, y, z], shift_m: [right, down, ahead], time_offset_s: offset.value };
  }

  function set(/** @type {Api.CorrectionJson} */ { turn_deg, shift_m, time_offset_s }) {
    for (const i of [0, 1, 2]) {
      turns[i].set(turn_deg[i]);
      shifts[i].set(shift_m[i]);
    }
    offset.set(time_offset_s);
  }

  function isChanged() {
    if (known === null) return false;
    const [a, b] = [flat(value()), flat(known.correction)];
    return a.some((number, i) => Math.abs(number - b[i]) > SAME);
  }

  return {
    root: panel(
      "Calibration",
      [...turns, ...shifts, offset].map((each) => each.root).concat(noTimes, offsetNote),
      [keep, back, zero],
      effect,
    ),
    value,
    set,
    isChanged,
    /** Shows what is stored. */
    take(/** @type {Api.AlignmentJson} */ answer) {
      known = answer;
      set(known.correction);
    },
    /** The frame whose image the time offset shows; null: the open one. */
    imageFrame() {
      if (known === null) return null;
      const wanted = -offset.value;
      const nearest = known.images.toSorted((a, b) => Math.abs(a.seconds - wanted) - Math.abs(b.seconds - wanted))[0];
      return nearest?.frame ?? null;
    },
    /** @param {boolean} isOff nothing can be kept now. */
    show(isOff) {
      if (known === null) return;
      const { correction, labels, drawn_images: drawn, is_virtual: isVirtual } = known;
      keep.disabled = back.disabled = isOff || !isChanged();
      zero.disabled = isOff || flat(correction).every((number) => number === 0);
      for (const { root } of [...turns, ...shifts]) root.hidden = isVirtual;
      keep.hidden = back.hidden = isVirtual;
      zero.hidden = isVirtual && zero.disabled;
      offset.root.hidden = isVirtual || known.images.length === 0;
      noTimes.hidden = isVirtual || known.images.length > 0;
      effect.textContent = isVirtual
        ? "The image is drawn from the cloud itself, so there is no calibration to correct."
        : `Holds for all frames of ${known.name}. ${count(labels, "3D box stays", "3D boxes stay")} in the cloud, and ` +
          "on the image they move with it. 2D boxes drawn on images stay there. Undo restores everything.";
      offsetNote.textContent =
        `${count(drawn, "frame has", "frames have")} boxes that were drawn on the image. With this time offset ` +
        "they are on another image: draw them again.";
      offsetNote.hidden = drawn === 0 || offset.value === correction.time_offset_s;
    },
  };
}

const flat = (/** @type {Api.CorrectionJson} */ { turn_deg, shift_m, time_offset_s }) => [
  ...turn_deg,
  ...shift_m,
  time_offset_s,
];
