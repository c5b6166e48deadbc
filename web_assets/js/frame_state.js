/**
 * The state of the open frame, and the one rule for replacing it: an older revision never replaces a newer one.
 *
 * The answers to saves, undos and reads may arrive in any order; each state has the frame's revision, which grows with
 * every change. Events report what others save. If an event arrives while a change of this page is being sent, it is
 * remembered, and the frame is read again afterwards (`isBehind`).
 */

import { createListeners } from "./events.js";

/** Maximum number of times that a frame is read if others keep changing it meanwhile. */
const MOST_READS = 4;
/** Number of states that are kept because their frames may be opened next. */
const MOST_AHEAD = 4;

export function createFrameState(/** @type {App} */ app) {
  const { state } = app;
  /** Frame id -> the newest revision that an event has reported. @type {Map<number, number>} */
  const heard = new Map();
  /** How often something may have been missed, and up to which of these the open frame was read again. */
  let [misses, caughtUp] = [0, 0];
  /** How often what is kept was given up: what was asked for before is not kept, either. */
  let givenUp = 0;
  /** What may be opened next, by its address; the newest last. @type {Map<string, FrameState>} */
  const ahead = new Map();

  // each project counts its frames from 1; the address of the picture, apart from a time offset, names the project
  const pictureOf = (/** @type {FrameState} */ frame) => frame.image.url.split("&")[0];
  const isSame = (/** @type {FrameState | null} */ a, /** @type {FrameState | null} */ b) =>
    a !== null && b !== null && a.frame.id === b.frame.id && pictureOf(a) === pictureOf(b);
  const pathOf = (/** @type {number} */ id, /** @type {string | null} */ bestFor) =>
    `${app.path("frames", id)}${bestFor === null ? "" : `?best_for=${encodeURIComponent(bestFor)}`}`;
  const isOutdated = (/** @type {FrameState} */ frame) => (heard.get(frame.frame.id) ?? -1) > frame.frame.revision;

  function giveUp() {
    givenUp += 1;
    ahead.clear();
  }

  function keep(/** @type {string} */ path, /** @type {FrameState} */ frame) {
    ahead.delete(path);
    ahead.set(path, frame);
    for (const oldest of [...ahead.keys()].slice(0, -MOST_AHEAD)) ahead.delete(oldest);
  }

  /** The state that is kept of a frame, or of that in which a label is seen best; null: none, or an outdated one. */
  function knownOf(/** @type {number} */ id, /** @type {string | null} */ bestFor) {
    const [here, best] = [ahead.get(pathOf(id, null)), ahead.get(pathOf(id, bestFor))];
    const isBest = here?.labels.some(({ uid, better_in }) => uid === bestFor && better_in === null);
    const frame = best ?? (isBest ? here : null);
    return frame && !isOutdated(frame) ? frame : null;
  }

  /** Another frame is open; the one before may be opened again. */
  function show(/** @type {FrameState} */ frame) {
    if (state.frame) keep(pathOf(state.frame.frame.id, null), state.frame);
    state.set({ frame });
  }

  const frames = {
    /** True if others have saved, or may have saved, a newer state. */
    get isBehind() {
      return state.frame !== null && (misses !== caughtUp || isOutdated(state.frame));
    },

    /**
     * Takes a state of the open frame, or of one that may be opened again. Returns false, and does not show the state,
     * if it is older or of another frame.
     */
    take(/** @type {FrameState} */ frame) {
      const isNewer = (/** @type {FrameState | null | undefined} */ than) =>
        isSame(frame, than ?? null) && frame.frame.revision >= (than?.frame.revision ?? 0);
      const path = pathOf(frame.frame.id, null);
      if (isNewer(ahead.get(path))) keep(path, frame);
      if (!isNewer(state.frame)) return false;
      state.set({ frame });
      return true;
    },

    /** The newest known state of a frame, which the operator may have left. */
    async of(/** @type {number} */ id) {
      const open = state.frame;
      const path = pathOf(id, null);
      return open?.frame.id === id ? open : (ahead.get(path) ?? /** @type {FrameState} */ (await app.api.get(path)));
    },

    /** Reads a frame that may be opened next, with the same arguments as `open`. */
    async prepare(
      /** @type {number} */ id,
      /** @type {string | null} */ bestFor,
      /** @type {RequestOptions} */ options,
    ) {
      const path = pathOf(id, bestFor);
      const own = givenUp;
      /** @type {FrameState} */
      const frame = knownOf(id, bestFor) ?? (await app.api.get(path, options));
      if (own === givenUp) keep(path, frame);
      return frame;
    },

    /**
     * Reads a frame and opens it, or that of its moment in which a camera sees a label best. What was read ahead is
     * opened at once, and then read again: it also tells what has changed elsewhere.
     */
    async open(/** @type {number} */ id, /** @type {string | null} */ bestFor, /** @type {RequestOptions} */ options) {
      const path = pathOf(id, bestFor);
      const known = knownOf(id, bestFor);
      ahead.delete(path);
      if (known && !isSame(known, state.frame)) {
        misses += 1;
        show(known);
        return known;
      }
      /** @returns {Promise<FrameState>} */
      const read = () => app.api.get(path, options);
      const before = misses;
      let frame = await read();
      for (let reads = 1; reads < MOST_READS && isOutdated(frame); reads += 1) frame = await read();
      caughtUp = before;
      // the open frame may be newer than the answer
      if (!isSame(frame, state.frame)) show(frame);
      else if (!frames.take(frame)) state.set({ frame: state.frame });
      return currentFrame(app);
    },

    /** Reads the open frame again if it is behind. If `isWelcome()` is false by then, the answer is ignored. */
    async refresh(isWelcome = () => true) {
      if (!frames.isBehind) return;
      const [before, { id }] = [misses, currentFrame(app).frame];
      const frame = await app.api.get(app.path("frames", id));
      if (!isWelcome()) return;
      frames.take(frame);
      // another one may have been opened meanwhile, as it was before
      if (state.frame?.frame.id === id) caughtUp = Math.max(caughtUp, before);
    },

    /** Handles an event: a frame has a new revision, perhaps saved by this page. */
    hear(/** @type {Messages["frame"]} */ { frame, revision }) {
      heard.set(frame, Math.max(heard.get(frame) ?? -1, revision));
    },

    /** Events may have been missed. */
    miss() {
      misses += 1;
      giveUp();
    },

    /** A change of the open frame has changed others, too: what was read of them ahead is read again. */
    giveUp,

    /** No frame is open any more: it cannot be read, or another project was opened. */
    close(isOtherProject = false) {
      if (isOtherProject) heard.clear();
      giveUp();
      caughtUp = misses;
      state.set({ frame: null });
    },
  };
  return frames;
}

/**
 * The open frame's state.
 *
 * @param {Pick<App, "state">} app
 * @throws {Error} no frame is open.
 */
export function currentFrame({ state }) {
  if (state.frame === null) throw new Error("no frame is open");
  return state.frame;
}

// -- the state shared by the whole page

/** @returns {State} */
export function createState(/** @type {StateValues} */ initial) {
  const listeners = createListeners();
  /** @type {State} */
  const state = {
    ...initial,

    // listeners are called even if a value is the same object as before
    set(changes) {
      Object.assign(state, changes);
      for (const [name, value] of Object.entries(changes)) listeners.call(name, value);
    },

    on: listeners.on,
  };
  return state;
}
