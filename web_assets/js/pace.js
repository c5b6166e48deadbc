/**
 * How many points of the cloud the 3D view draws: all of them at rest, and while the camera moves as many as keep 20
 * frames a second on this computer. The server sends the points in random order, so that any number of the first ones
 * is the cloud thinned evenly.
 */

// The time of a frame while the camera moves, ms, and one that leaves room for more points.
const [SLOWEST_MS, FAST_MS] = [50, 35];
const LEAST = 5_000;
// The camera is at rest if nothing has moved it for this time, ms.
const REST_MS = 300;
// Frames for one decision, and the largest change of the number by one.
const FRAMES = 5;
const [LOWER, HIGHER] = [0.3, 1.5];

/** @param {number} most the number before the first frames are measured. */
export function createPace(most) {
  let movedAt = -Infinity;
  /** @type {number | null} */
  let drawnAt = null;
  let drawn = 0;
  /** @type {number[]} */
  let times = [];

  return {
    /** While the camera moves: no more points than these. */
    get most() {
      return most;
    },

    /** The camera, a box or the cloud has just changed. */
    moved(/** @type {number} */ now) {
      movedAt = now;
    },

    /** A frame of `count` points is about to be drawn; returns how many to draw. */
    draw(/** @type {number} */ count, /** @type {number} */ now) {
      if (now - movedAt > REST_MS) {
        drawnAt = null;
        times = [];
        return count;
      }
      if (drawnAt !== null) times.push(now - drawnAt);
      drawnAt = now;
      if (times.length >= FRAMES) {
        const time = times.sort((a, b) => a - b)[FRAMES >> 1];
        if (time > SLOWEST_MS) most = Math.max(LEAST, drawn * Math.max(SLOWEST_MS / time, LOWER));
        else if (time < FAST_MS && drawn === Math.floor(most)) most *= Math.min(SLOWEST_MS / time, HIGHER);
        times = [];
      }
      drawn = Math.min(count, Math.floor(most));
      return drawn;
    },
  };
}
