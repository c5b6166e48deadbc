/**
 * The logic of the timeline, without display: which places it shows, which lanes, and what is under the pointer. A place
 * is the index of a frame among those of the recording; the box of a frame reaches from its place to the next one.
 */

import { count } from "../dom.js";

/** The fewest places that are shown if there are more. */
const LEAST = 16;

/** @returns {Stretch} */
export const whole = (/** @type {number} */ total) => ({ first: 0, count: Math.max(total, 1) });

/** A range shown larger (factor > 1) or smaller, in which the place `at` stays where it was. @returns {Stretch} */
export function zoomed(
  /** @type {Stretch} */ { first, count },
  /** @type {number} */ factor,
  /** @type {number} */ at,
  /** @type {number} */ total,
) {
  const now = Math.min(Math.max(count / factor, Math.min(LEAST, total)), total);
  return moved({ first: at - ((at - first) * now) / count, count: now }, 0, total);
}

/** A range moved by this many places, within the recording. @returns {Stretch} */
export const moved = (
  /** @type {Stretch} */ { first, count },
  /** @type {number} */ by,
  /** @type {number} */ total,
) => ({ first: Math.max(Math.min(first + by, total - count), 0), count });

/**
 * The range that shows a place: the same one if it does already, or else moved so that the place is in its middle.
 *
 * @returns {Stretch}
 */
export function showing(/** @type {Stretch} */ range, /** @type {number} */ place, /** @type {number} */ total) {
  const isShown = place >= range.first && place + 1 <= range.first + range.count;
  return isShown ? range : moved(range, place + 0.5 - range.first - range.count / 2, total);
}

/**
 * The pictures that fit into a strip: each stands for the frames from its own to the next picture's. Their steps are
 * powers of two, so that a strip that is zoomed or moved shows pictures that are there already.
 *
 * @param {Stretch} range
 * @param {number} total
 * @param {number} most how many fit beside each other.
 * @returns {{ place: number, first: number, last: number }[]} the frame that is shown, and the first and last place.
 */
export function pictures(range, total, most) {
  const end = Math.min(range.first + range.count, total);
  let step = 1;
  while (range.count / step > most) step *= 2;
  const found = [];
  for (let place = Math.floor(range.first / step) * step; place < end; place += step)
    found.push({ place, first: Math.max(place, range.first), last: Math.min(place + step, end) });
  return found;
}

/** The index of the first span that ends at this place or later. */
function indexAt(/** @type {Span[]} */ spans, /** @type {number} */ place) {
  let [low, high] = [0, spans.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (spans[middle][1] < place) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The spans that a range shows, in order. */
export function spansIn(/** @type {Lane} */ { spans }, /** @type {Stretch} */ { first, count }) {
  const found = [];
  for (let i = indexAt(spans, Math.floor(first)); i < spans.length && spans[i][0] < first + count; i += 1)
    found.push(spans[i]);
  return found;
}

/** The lanes of tracks that have begun, and have not ended, within a range. */
export const lanesIn = (/** @type {Lane[]} */ lanes, /** @type {Stretch} */ { first, count }) =>
  lanes.filter(({ spans }) => spans[0][0] < first + count && spans[spans.length - 1][1] >= Math.floor(first));

/** The span of a lane at a place, or null. */
export function spanAt(/** @type {Lane} */ { spans }, /** @type {number} */ place) {
  const span = spans[indexAt(spans, place)];
  return span && span[0] <= place ? span : null;
}

/**
 * The place that a click means: that of the nearest box of the lane within reach, or else the one under the pointer.
 *
 * @param {Lane | null} lane
 * @param {number} at where the pointer is, with a fraction.
 * @param {number} reach in places.
 * @param {number} total
 */
export function placeAt(lane, at, reach, total) {
  const place = Math.min(Math.max(Math.floor(at), 0), total - 1);
  if (!lane || spanAt(lane, place)) return place;
  const next = indexAt(lane.spans, place);
  const ends = [lane.spans[next - 1]?.[1], lane.spans[next]?.[0]].filter((end) => end !== undefined);
  const distance = (/** @type {number} */ end) => Math.abs(end + 0.5 - at) - 0.5;
  const nearest = ends.toSorted((a, b) => distance(a) - distance(b))[0];
  return nearest !== undefined && distance(nearest) <= reach ? nearest : place;
}

/** The class of most boxes of a lane; null for boxes without a track. */
export function classOf(/** @type {Lane} */ { track_id, spans }) {
  if (track_id === null) return null;
  /** @type {Map<string, number>} */
  const boxes = new Map();
  for (const [first, last, name] of spans) boxes.set(name ?? "", (boxes.get(name ?? "") ?? 0) + last - first + 1);
  return [...boxes].toSorted((a, b) => b[1] - a[1])[0][0];
}

/** Such as "car 12". */
export const nameOf = (/** @type {Lane} */ lane) =>
  lane.track_id === null ? "no track" : `${classOf(lane)} ${lane.track_id}${lane.still ? " (still)" : ""}`;

/**
 * What the lanes show, in words: how many tracks, and the one that is selected.
 *
 * @param {Lane[]} lanes
 * @param {number | null} track
 * @param {[number, number] | null} part the first and last place that is selected of it.
 */
export function describe(lanes, track, part) {
  const tracks = count(lanes.filter(({ track_id }) => track_id !== null).length, "track");
  const lane = lanes.find(({ track_id }) => track_id !== null && track_id === track);
  if (!lane) return tracks;
  const boxes = (/** @type {Span[]} */ spans) => spans.reduce((sum, [first, last]) => sum + last - first + 1, 0);
  const reviewed = boxes(lane.spans.filter(([, , , level]) => level === 0));
  const selected = part ? `, frames ${part[0] + 1} to ${part[1] + 1} selected` : "";
  return `${tracks}; ${nameOf(lane)}: in ${count(boxes(lane.spans), "frame")}, ${reviewed} reviewed${selected}`;
}

/** What a span is, in words. */
export function wordsOf(/** @type {Span | null} */ span) {
  if (!span) return "no box";
  const level = span[3];
  return level === 0 ? "reviewed" : `proposed${level > 1 ? `, doubt about ${25 * (level - 1)} %` : ""}`;
}
