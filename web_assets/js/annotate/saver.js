/**
 * Saves drawn objects, one change after the other and in one line with those of the desk: each is based on the revision
 * that resulted from the previous one. A change's body is made when it is sent, from the frame's state at that time, so
 * that it can be applied to the others' version.
 */

import { button, h, patch } from "../dom.js";
import { isStale } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { askVersion } from "../stale.js";
import { naming } from "./items.js";

/**
 * @param {App} app
 * @param {Desk} desk
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
      await desk.enqueue(async () => {
        const state = await stateOf(frame);
        namingsSent = namings;
        const body = { revision: state.frame.revision, ...entry.body(state) };
        /** @type {FrameState | Api.SaveOut} */
        const answer = await app.api.change(app.path("frames", frame, ...entry.path), body);
        if ("state" in answer) entry.done?.(answer);
        take("state" in answer ? answer.state : answer, frame);
      });
      waiting.shift();
    } catch (error) {
      if (isStale(error)) await settle(error, entry);
      // an error about a name that the change no longer has does not count: it is sent again
      else if (namingsSent === namings) problem = error instanceof Error ? error : new Error(String(error));
    }
  }

  /** The state of a change's frame, which the operator may have left. @returns {FrameState | Promise<FrameState>} */
  function stateOf(/** @type {number} */ frame) {
    const open = app.state.frame;
    return open?.frame.id === frame ? open : app.api.get(app.path("frames", frame));
  }

  function take(/** @type {FrameState} */ state, /** @type {number} */ frame) {
    if (app.state.frame?.frame.id !== frame) return;
    app.frames.take(state);
    if (waiting.length === 1) onSaved(currentFrame(app));
  }

  /**
   * Lets the operator choose. "theirs": all waiting changes are dropped, but stay visible. "mine": the change is
   * applied to the others' version and sent again.
   */
  async function settle(/** @type {StaleError} */ error, /** @type {FrameChange} */ change) {
    const choice = await askVersion({ theirs: error.body.state, mine: change.mine(error.body.state) });
    const dropped = choice === "theirs" ? waiting : [];
    if (choice === "theirs") waiting = [];
    app.frames.take(error.body.state);
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
