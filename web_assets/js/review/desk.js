/**
 * What an operator does in Review, without any of its looks: which box is selected, what of it is not saved yet, and every
 * change on its way to the server, one after the other.
 *
 * A box under the mouse is a draft: `preview` shows it everywhere without a round trip, `commit` saves it as one edit. A
 * draft that could not be saved stays until it is saved or reverted. Listeners get what has changed: "frame", "selection",
 * "draft" or "saving".
 */

import { copyBox, sameBox } from "../box3d.js";
import { resolveStale } from "./stale.js";

/** Labels that still want a decision. */
export const isOpen = (label) => label.state === "proposed";

export function createDesk(app) {
  const listeners = new Set();
  let uid = null;
  let draft = null;
  let problem = null;
  let waiting = 0;
  let in_flight = null;
  let leave = () => {};
  let chain = Promise.resolve();

  const tell = (what) => listeners.forEach((fn) => fn(what));
  const labels = () => app.state.frame?.labels ?? [];
  const stored = (id = uid) => labels().find((label) => label.uid === id) ?? null;

  /** Does a task after all others; its own failure is shown and stops nothing else. */
  function enqueue(task) {
    waiting += 1;
    tell("saving");
    const done = chain.then(task).finally(() => {
      waiting -= 1;
      tell("saving");
    });
    chain = done.catch(() => {});
    return done;
  }

  /** Sends changes of the open frame; resolves to true where they are saved. */
  function send(changes, subject) {
    const { id } = app.state.frame.frame;
    return enqueue(async () => {
      try {
        await post(id, changes, subject);
        problem = null;
        return true;
      } catch (error) {
        problem = error.message;
        app.toast(error);
        return false;
      }
    });
  }

  async function post(id, changes, subject) {
    const body = { revision: app.state.frame.frame.revision, changes, subject };
    try {
      take(await app.api.change(app.path("frames", id, "changes"), body));
    } catch (error) {
      if (!error.isStale) throw error;
      await resolveStale(app, error, { changes, subject, take });
    }
  }

  function take(frame) {
    if (frame.frame.id === app.state.frame?.frame.id) app.state.set({ frame });
  }

  /** After every new state of the frame: what is selected may be gone, what was drafted may be saved. */
  function settle() {
    if (uid !== null && !stored()) [uid, draft] = [null, null];
    tell("frame");
  }

  /** What is not saved yet is on its way after this, as far as it has not failed before. */
  function keep() {
    leave();
    if (draft && draft !== in_flight && !problem) void commit();
  }

  function select(id) {
    if (id === uid) return;
    keep();
    uid = id;
    draft = null;
    problem = null;
    tell("selection");
  }

  const isChanged = (label, wanted) =>
    label.label !== wanted.label || label.track_id !== wanted.track_id || !sameBox(label.box, wanted.box);

  /** Saves the draft, if there is one, as one edit that took so many actions. */
  async function commit(actions = 1) {
    if (!draft || !stored()) return true;
    app.effort.action(actions);
    return save(draft);
  }

  async function save(wanted) {
    const { uid: id, label, box, track_id } = wanted;
    in_flight = wanted;
    const saved = await send([{ kind: "edit", uid: id, label, box, track_id }], id);
    if (in_flight === wanted) in_flight = null;
    if (saved && draft === wanted) draft = null;
    tell("draft");
    return saved;
  }

  function revert() {
    draft = null;
    problem = null;
    tell("draft");
  }

  return {
    get uid() {
      return uid;
    },
    get problem() {
      return problem;
    },
    get isSaving() {
      return waiting > 0;
    },
    get hasDraft() {
      return draft !== null;
    },
    labels,
    stored,

    /** The selected label as the operator sees it: with the draft's box, class and track; or null. */
    get shown() {
      const label = stored();
      return label && draft ? { ...label, ...draft } : label;
    },

    /** Calls `fn("frame" | "selection" | "draft" | "saving")` after changes. Returns the function that ends this. */
    on(fn) {
      listeners.add(fn);
      return () => listeners.delete(fn);
    },

    select,
    /** `fn()` ends what is being done to the selected box, before another one is selected. */
    onLeave: (fn) => (leave = fn),
    settle,
    enqueue,

    /** Shows the selected label with other values ({box?, label?, track_id?}) without saving them. */
    preview(changes) {
      const label = stored();
      if (!label) return;
      const base = draft ?? { uid: label.uid, label: label.label, track_id: label.track_id, box: copyBox(label.box) };
      const wanted = { ...base, ...changes };
      draft = isChanged(label, wanted) ? wanted : null;
      tell("draft");
    },
    commit,
    revert,

    /** Shows and saves in one go. */
    edit(changes) {
      this.preview(changes);
      return commit();
    },

    /** Tries again to save what could not be saved. */
    retry: () => (draft ? save(draft) : Promise.resolve(true)),

    /** One of {kind: "accept" | "reject" | "delete"} for a label. */
    decide(kind, id) {
      app.effort.action();
      return send([{ kind, uid: id }], id);
    },

    /** Finalises the frame, or opens it again. */
    finalise(on) {
      app.effort.action();
      return send([{ kind: on ? "finalise" : "reopen" }], null);
    },

    /** The reviewed boxes of the frame before, as far as this one lacks them; resolves to how many there were. */
    copyPrevious() {
      const { id } = app.state.frame.frame;
      app.effort.action();
      return enqueue(async () => {
        const before = labels().length;
        const copy = () => app.api.change(app.path("frames", id, "copy"), { revision: app.state.frame.frame.revision, from: null });
        try {
          take(await copy());
        } catch (error) {
          if (!error.isStale) throw error;
          // boxes are only added, so nothing of somebody else's can be lost
          take(error.body.state);
          take(await copy());
        }
        return labels().length - before;
      });
    },

    /** Another operator's state of this frame, unless a change of ours is on its way (its answer brings the newest). */
    refresh() {
      const { id } = app.state.frame.frame;
      return enqueue(async () => take(await app.api.get(app.path("frames", id))));
    },

    /** Waits until everything is saved. */
    flush() {
      keep();
      return chain;
    },
  };
}
