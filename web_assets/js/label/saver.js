/**
 * Saves one change after the other, each on the revision that the one before has led to.
 *
 * A change is {path, body(state) -> request without revision and effort, mine(state) -> what stale.js shows, done(answer),
 * after}: its body is made when it is sent, from what the server has then, so it can be put on top of somebody else's. It
 * waits for the promise `after`: the views that a drag leads to are shown first, and the server then has them at hand. One that
 * cannot be said before its turn is {item, make() -> change, or null where nothing is left to save}; where that fails it
 * is not saved, and made when it is tried again.
 */

import { askVersion } from "../stale.js";

/**
 * @param {(state: object) => void} onSaved with the newest state, when the last waiting change is saved.
 * @param {(change: object) => void} onDropped the operator took the others' version; the change is not saved.
 * @param {(saving: boolean, problem: Error | null) => void} onBusy
 */
export function createSaver(app, { onSaved, onDropped, onBusy }) {
  let waiting = [];
  let running = null;
  let problem = null;

  async function run() {
    onBusy(true, null);
    problem = null;
    while (waiting.length && !problem) await send(waiting[0]);
    running = null;
    onBusy(false, problem);
  }

  async function send(entry) {
    let change = entry;
    try {
      if (entry.make) entry.made ??= await entry.make();
      change = entry.make ? entry.made && { ...entry.made, frame: entry.frame } : entry;
      await change?.after;
      if (waiting[0] !== entry) return;
      if (!change) {
        waiting.shift();
        return;
      }
      const state = await stateOf(change.frame);
      const answer = await app.api.change(app.path("frames", change.frame, ...change.path), { revision: state.frame.revision, ...change.body(state) });
      change.done?.(answer);
      take(answer.state ?? answer, change);
      waiting.shift();
    } catch (error) {
      if (error.isStale) await settle(error, change);
      else problem = error;
    }
  }

  /** The frame that a change belongs to may have been left since. */
  function stateOf(frame) {
    const open = app.state.frame;
    return open?.frame.id === frame ? open : app.api.get(app.path("frames", frame));
  }

  function take(state, change) {
    if (app.state.frame?.frame.id !== change.frame) return;
    app.frames.take(state);
    if (waiting.length === 1) onSaved(app.state.frame);
  }

  /** Theirs: all that waits here is given up, and kept in sight. Mine: the same again, on top of theirs. */
  async function settle(error, change) {
    const choice = await askVersion({ theirs: error.body.state, mine: change.mine(error.body.state) });
    const dropped = choice === "theirs" ? waiting.map((entry) => entry.made ?? entry) : [];
    if (choice === "theirs") waiting = [];
    app.frames.take(error.body.state);
    dropped.forEach(onDropped);
  }

  return {
    /** Queues a change of the open frame. */
    save(change) {
      waiting.push({ ...change, frame: app.state.frame.frame.id });
      running ??= run();
    },
    /** Tries again after a failure. */
    async retry() {
      if (waiting.length) await (running ??= run());
    },
    /** Gives up what waits. */
    discard() {
      waiting = [];
      problem = null;
      onBusy(false, null);
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
    /** Resolves when nothing waits any more, or a change has failed. */
    idle: async () => {
      while (running) await running;
    },
  };
}
