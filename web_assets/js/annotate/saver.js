/**
 * Saves changes of frames, one request after the other. A change's body is made when it is sent, from the state of its
 * frame that the change before gave: so it is based on that revision, and can be applied to the others' version, too.
 * The operator may have gone on to another frame by then.
 */

import { button, h, patch } from "../dom.js";
import { isStale, isTrackTaken } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { askVersion } from "../stale.js";
import { frameName } from "../timeline/reading.js";
import { naming } from "./items.js";

/**
 * What sends all changes.
 *
 * @param {App} app
 * @param {() => unknown} onWaiting called when a change begins to wait, and when it is saved or has failed.
 */
export function createSender(app, onWaiting) {
  let waiting = 0;
  /** @type {Promise<unknown>} */
  let chain = Promise.resolve();
  /** The frames of the moments with changes that wait. @type {number[][]} */
  let moments = [];
  /** The newest states of these frames that are known, however many frames are opened meanwhile. @type {Map<number, FrameState>} */
  const states = new Map();

  function know(/** @type {FrameState} */ state) {
    const { id, revision } = state.frame;
    if (revision >= (states.get(id)?.frame.revision ?? 0)) states.set(id, state);
  }

  /**
   * Runs a task after all earlier ones. Later tasks run even if it fails.
   *
   * @template T
   * @param {() => Promise<T>} task
   */
  function enqueue(task) {
    waiting += 1;
    onWaiting();
    const done = chain.then(task).finally(() => {
      waiting -= 1;
      onWaiting();
    });
    chain = done.catch(() => {});
    return done;
  }

  /**
   * Sends a change of a frame. Resolves to the answer, or to null if the operator keeps the others' version.
   *
   * @template [T=unknown]
   * @param {number} frame
   * @param {FrameChange<T>} change
   * @returns {Promise<T | null>}
   */
  function send(frame, change) {
    const open = app.state.frame?.frame;
    const moment = open?.id === frame ? [frame, ...Object.values(open.cameras)] : [frame];
    moments.push(moment);
    if (open?.id === frame) know(currentFrame(app));
    return enqueue(async () => {
      try {
        return await post(frame, change);
      } finally {
        moments = moments.filter((other) => other !== moment);
        if (!moments.some(([id]) => id === frame)) states.delete(frame);
      }
    });
  }

  function take(/** @type {FrameState} */ state) {
    know(state);
    app.frames.take(state);
  }

  /**
   * @template T
   * @param {number} frame
   * @param {FrameChange<T>} change
   * @returns {Promise<T | null>}
   */
  async function post(frame, change, isFirst = true) {
    if (app.state.frame?.frame.id === frame) know(app.state.frame);
    // not read anew: others may have changed what the operator saw
    const state = states.get(frame) ?? (await app.frames.of(frame));
    const revision = (isFirst ? change.base?.() : null) ?? state.frame.revision;
    try {
      const body = { revision, ...change.body(state) };
      /** @type {T} */
      const answer = await app.api.change(app.path("frames", frame, ...change.path), body);
      change.done?.(answer);
      const now = change.stateOf ? change.stateOf(answer) : /** @type {FrameState} */ (answer);
      if (now) take(now);
      return answer;
    } catch (error) {
      if (isTrackTaken(error) && change.instead) {
        const other = await change.instead(error, state);
        return other && post(frame, other, false);
      }
      if (!isStale(error)) throw error;
      const theirs = error.body.state;
      const name = app.state.frame?.frame.id === frame ? undefined : frameName(app.state, frame, theirs.frame.key);
      const chosen = change.mine ? await askVersion({ theirs, mine: change.mine(theirs), name }) : null;
      take(theirs);
      if (chosen === "theirs") return null;
      if (!change.mine && !(change.isSentAgain && isFirst)) throw error;
      return post(frame, change, false);
    }
  }

  return {
    enqueue,
    send,
    get waiting() {
      return waiting;
    },
    /** Whether changes of a frame's moment wait: its state is not known yet. */
    isOf: (/** @type {number} */ frame) => moments.some((frames) => frames.includes(frame)),
    /** Waits until everything is saved or has failed, also what is added meanwhile. */
    async idle() {
      while (waiting > 0) await chain;
    },
  };
}

/**
 * Saves drawn objects. What fails waits, with the later ones, until it is tried again.
 *
 * @param {App} app
 * @param {Pick<Desk, "send">} desk
 * @param {object} listeners
 * @param {(state: FrameState) => void} listeners.onSaved called when the last waiting change is saved.
 * @param {(change: FrameChange) => void} listeners.onDropped the operator kept the others' version; this
 *     change is not saved.
 * @param {(isSaving: boolean) => void} listeners.onBusy called when saving begins, and when it ends or fails.
 */
export function createSaver(app, desk, { onSaved, onDropped, onBusy }) {
  /** @type {Waiting[]} */
  let waiting = [];
  /** @type {Promise<void> | null} */
  let running = null;
  /** @type {Error | null} */
  let problem = null;
  // how often waiting changes got other names of classes
  let namings = 0;

  async function run() {
    problem = null;
    onBusy(true);
    while (waiting.length && !problem) await send(waiting[0]);
    running = null;
    onBusy(false);
  }

  async function send(/** @type {Waiting} */ entry) {
    const { frame } = entry;
    let namingsSent = namings;
    try {
      const body = (/** @type {FrameState} */ state) => {
        namingsSent = namings;
        return entry.body(state);
      };
      const answer = await desk.send(frame, { ...entry, body });
      if (!answer) return drop();
      // it may have been discarded meanwhile
      if (waiting[0] === entry) waiting.shift();
      const open = app.state.frame;
      if (waiting.length === 0 && open?.frame.id === frame) onSaved(open);
    } catch (error) {
      // an error about a name that the change no longer has does not count: it is sent again
      if (namingsSent === namings) problem = error instanceof Error ? error : new Error(String(error));
    }
  }

  /** The operator keeps the others' version: all waiting changes are dropped, but stay visible. */
  function drop() {
    const dropped = waiting;
    waiting = [];
    if (app.state.frame) app.frames.take(app.state.frame);
    for (const one of dropped) onDropped(one);
  }

  return {
    /** Queues a change of the open frame. */
    save(/** @type {FrameChange} */ change) {
      waiting.push({ ...change, frame: currentFrame(app).frame.id });
      running ??= run();
    },
    /** Tries again after a failure. */
    async retry() {
      if (waiting.length) running ??= run();
      await running;
    },
    /**
     * Gives waiting changes the new names of classes, and tries again what was refused.
     *
     * @param {Record<string, string>} renamed old name -> new name.
     */
    relabel(renamed) {
      if (!Object.keys(renamed).length) return;
      namings += 1;
      const named = naming(renamed);
      for (const change of waiting) change.relabel?.(named);
      if (problem && waiting.length) running ??= run();
    },
    /** The classes of the boxes that wait. */
    labels: () => new Set(waiting.map((entry) => entry.item?.image_box.label).filter((label) => label !== undefined)),
    /** Drops all waiting changes. */
    discard() {
      waiting = [];
      problem = null;
      onBusy(false);
    },
    get isBusy() {
      return waiting.length > 0;
    },
    get waiting() {
      return waiting.length;
    },
    get problem() {
      return problem;
    },
    /** Resolves when no change is waiting any more, or one has failed. */
    idle: async () => {
      while (running) await running;
    },
  };
}

// -- why a change could not be saved, and what to do

/**
 * @param {ModeApp} app
 * @param {Saver} saver
 * @param {object} listeners
 * @param {(renamed: Record<string, string>) => void} listeners.onRelabel gives unsaved boxes another class.
 * @param {() => void} listeners.onDiscard drops what is not saved.
 */
export function createSaveProblem(app, saver, { onRelabel, onDiscard }) {
  const root = h("span.problem", { role: "alert", "data-testid": "save-problem" });

  function choice(/** @type {string} */ gone) {
    const options = app.state.project.classes.map((name) => h("option", name));
    const onchange = (/** @type {Event} */ { currentTarget }) =>
      onRelabel({ [gone]: /** @type {HTMLSelectElement} */ (currentTarget).value });
    return h(
      "select",
      { "aria-label": `Class in place of ${gone}`, "data-testid": "save-as", onchange },
      h("option", { value: "", disabled: true, selected: true }, "save it as …"),
      options,
    );
  }

  function show() {
    if (!saver.problem) return patch(root);
    const gone = [...saver.labels()].find((label) => !app.state.project.classes.includes(label));
    const text = `Not saved: ${saver.problem.message}`;
    patch(
      root,
      h("span.ellipsis", { title: text }, text),
      gone === undefined ? button("Try again", () => saver.retry()) : choice(gone),
      button("Discard", onDiscard),
    );
  }

  return { root, show };
}
