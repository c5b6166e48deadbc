// What is stored of a recording's alignment, and what is set and not kept yet. Pure functions; angles are degrees.

import { aboutAxis, dot, IDENTITY, length, multiply, scale, transpose } from "../rotation.js";
import { anglesOf, RAD, upOf } from "./level.js";

/** Numbers that differ by less are equal. */
const SAME = 1e-9;
/** A camera that is level, which is shown while no up direction is known. */
const LEVEL = { roll: 0, pitch: 0 };
/** @type {Api.CorrectionJson} */
export const NONE = { turn_deg: [0, 0, 0], shift_m: [0, 0, 0], time_offset_s: 0 };

/**
 * `correction` and `level`, that of the camera with the stored correction, are null where they are as stored: so another
 * frame, of which the files may know another up direction, shows its own. `proposed`: the level is the server's.
 *
 * @typedef {object} Setting
 * @property {Api.AlignmentJson} stored
 * @property {Api.CorrectionJson | null} correction
 * @property {Level | null} level
 * @property {Api.EstimatedUp | null} proposed
 *
 * @typedef {{ roll: number, pitch: number }} Level
 */

/** What is shown of an answer: what is set stays on another frame of the same recording that nobody has adjusted since. */
export function taken(/** @type {Setting | null} */ before, /** @type {Api.AlignmentJson} */ stored) {
  const isSame = before?.stored.recording === stored.recording && before.stored.adjusted === stored.adjusted;
  return isSame ? { ...before, stored } : asStored(stored);
}

/** @returns {Setting} */
export const asStored = (/** @type {Api.AlignmentJson} */ stored) => ({
  stored,
  correction: null,
  level: null,
  proposed: null,
});

/** What is left to keep once the correction or the level is stored; the other one stays as it is shown. */
export function kept(
  /** @type {Setting} */ before,
  /** @type {Api.AlignmentJson} */ stored,
  /** @type {"correction" | "up"} */ what,
) {
  if (what === "up") return { ...asStored(stored), correction: before.correction };
  const up = turnedUp({ ...before, correction: stored.correction });
  return { ...before, stored, correction: null, level: before.level && anglesOf(up) };
}

export const correctionOf = (/** @type {Setting} */ { stored, correction }) => correction ?? stored.correction;

export const isCorrected = (/** @type {Setting} */ { stored, correction }) =>
  correction !== null && numbersOf(correction).some((x, i) => Math.abs(x - numbersOf(stored.correction)[i]) > SAME);

/** Turn, shift and time offset, one after the other. */
export const numbersOf = (/** @type {Api.CorrectionJson} */ { turn_deg, shift_m, time_offset_s }) => [
  ...turn_deg,
  ...shift_m,
  time_offset_s,
];

/** The correction with another one of its numbers. @returns {Api.CorrectionJson} */
export function withNumber(
  /** @type {Api.CorrectionJson} */ correction,
  /** @type {number} */ index,
  /** @type {number} */ value,
) {
  const [a, b, c, x, y, z, seconds] = numbersOf(correction).with(index, value);
  return { turn_deg: [a, b, c], shift_m: [x, y, z], time_offset_s: seconds };
}

/** The level that is shown. @returns {Level} */
export const levelOf = (/** @type {Setting} */ { stored, level }) =>
  level ?? (stored.up === null ? LEVEL : anglesOf(stored.up));

/** Whether the level that is shown is not the stored one. */
export const isTurned = (/** @type {Setting} */ { stored, level }) =>
  level !== null && (stored.up === null || dot(upOf(level), stored.up) < 1 - SAME);

/** Whether a level would be lost: a proposal can be made again. */
export const isTurnedByHand = (/** @type {Setting} */ setting) => setting.proposed === null && isTurned(setting);

/** The up direction that is shown, in the camera frame of the correction that is shown. */
export function turnedUp(/** @type {Setting} */ setting) {
  const stored = transpose(rotationOf(setting.stored.correction.turn_deg));
  const up = upOf(levelOf(setting));
  return multiply(rotationOf(correctionOf(setting).turn_deg), stored).map((row) => dot(row, up));
}

/** The matrix of a rotation vector in degrees. */
export function rotationOf(/** @type {Vector} */ turn) {
  const angle = length(turn);
  return angle === 0 ? IDENTITY : aboutAxis(scale(turn, 1 / angle), angle * RAD);
}

/** The frame whose image the time offset shows; null: the open one. */
export function imageFrame(/** @type {Setting} */ setting) {
  const wanted = -correctionOf(setting).time_offset_s;
  const apart = (/** @type {Api.ImageAt} */ { seconds }) => Math.abs(seconds - wanted);
  return setting.stored.images.toSorted((a, b) => apart(a) - apart(b))[0]?.frame ?? null;
}
