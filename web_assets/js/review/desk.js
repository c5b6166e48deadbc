/**
 * What an operator does in Review, without any of its looks: which box is selected, what is not saved yet, and every change
 * on its way to the server, one after the other.
 *
 * A box under the mouse is a draft: `preview` shows it everywhere without a round trip, `commit` saves it as one edit. A
 * draft that could not be saved stays with its box, whatever is selected next, until it is saved or reverted. A new box is
 * here alone until it is accepted; what it has cost is counted then. Listeners get what has changed: "frame", "selection",
 * "draft" or "saving".
 */

import { copyBox, sameBox } from "../box3d.js";
import { count } from "../dom.js";
import { resolveStale } from "./stale.js";

/** Labels that still want a decision. */
export const isOpen = (label) => label.state === "proposed";

export function createDesk(app) {
  const listeners = new Set();
  /** uid -> {wanted, sending, sent, problem} of the boxes of the frame `home`. */
  const drafts = new Map();
  /** uid -> {label, image_box, actions, problem, sending} of new boxes of the same frame. */
  const added = new Map();
  let number = 0;
  let home = null;
  let uid = null;
  let waiting = 0;
  let leave = () => {};
  let chain = Promise.resolve();

  const tell = (what) => listeners.forEach((fn) => fn(what));
  const labels = () => [...(app.state.frame?.labels ?? []), ...[...added.values()].map(({ label }) => label)];
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

  /** Sends changes of the open frame; resolves to null where they are saved, else to what was wrong. */
  function send(changes, subject) {
    const { id } = app.state.frame.frame;
    return enqueue(async () => {
      try {
        await post(id, changes, subject);
        return null;
      } catch (error) {
        app.toast(error);
        return error;
      }
    });
  }

  async function post(id, changes, subject) {
    const body = { revision: app.state.frame.frame.revision, changes, subject };
    try {
      app.frames.take(await app.api.change(app.path("frames", id, "changes"), body));
    } catch (error) {
      if (!error.isStale) throw error;
      await resolveStale(app, error, { changes, subject, take: app.frames.take });
    }
  }

  /** After every new state of the frame: what is selected may be gone, what was drafted may be saved. */
  function settle() {
    const { id } = app.state.frame.frame;
    if (id !== home) forget();
    home = id;
    for (const gone of [...drafts.keys()].filter((known) => !stored(known))) {
      // one that is being sent is told of by its own answer
      const is_news = !drafts.get(gone).sending;
      drafts.delete(gone);
      if (is_news) app.toast("The box that you were changing is not there any more: somebody has deleted it.", "warn");
    }
    if (uid !== null && !stored()) uid = null;
    tell("frame");
  }

  function forget() {
    drafts.clear();
    added.clear();
  }

  /** What is not saved yet is on its way after this, as far as it has not failed before. */
  function keep() {
    leave();
    const draft = drafts.get(uid);
    if (draft && !draft.problem && draft.sending !== draft.wanted) void commit();
  }

  function select(id) {
    if (id === uid) return;
    keep();
    uid = id;
    tell("selection");
  }

  const isChanged = (label, wanted) =>
    label.label !== wanted.label || label.track_id !== wanted.track_id || !sameBox(label.box, wanted.box);

  /** Saves the selected box's draft, if there is one, as one edit that took so many actions. */
  async function commit(actions = 1) {
    if (!drafts.has(uid) || !stored()) return true;
    if (added.has(uid)) return change(uid, actions);
    const draft = drafts.get(uid);
    if (draft.sending === draft.wanted) return draft.sent;
    app.effort.action(actions);
    return save(uid);
  }

  /** A new box is another one now; nobody else knows of it yet. */
  function change(id, actions) {
    const entry = added.get(id);
    entry.label = seen(entry.label);
    entry.actions += actions;
    drafts.delete(id);
    tell("draft");
    return true;
  }

  /** Accepts a new box: only now it is stored. Accepted again meanwhile, it is stored once. */
  function create(id) {
    const entry = added.get(id);
    return (entry.sending ??= storeNew(id, entry).finally(() => (entry.sending = null)));
  }

  async function storeNew(id, entry) {
    // presses of the arrow keys that came just before
    if (uid === id) leave();
    change(id, 1);
    const { label, box, track_id } = entry.label;
    const known = new Set(labels().map((one) => one.uid));
    app.effort.action(entry.actions);
    const error = await send([{ kind: "create", label, box, track_id, image_box: entry.image_box }], null);
    entry.problem = error?.message ?? null;
    // it is tried again with what it takes then
    if (error) entry.actions = 0;
    else added.delete(id);
    if (!error && uid === id) uid = labels().find((one) => !known.has(one.uid))?.uid ?? null;
    tell(error ? "draft" : "selection");
    return !error;
  }

  function remove(id) {
    added.delete(id);
    drafts.delete(id);
    if (uid === id) uid = null;
    tell("selection");
    return true;
  }

  function save(id) {
    const draft = drafts.get(id);
    return (draft.sent = sendDraft(id, draft));
  }

  async function sendDraft(id, draft) {
    const wanted = draft.wanted;
    draft.sending = wanted;
    const { label, box, track_id } = wanted;
    const before = stored(id);
    // which object it is says nothing about the box: its review stays as it is
    const is_track_only = before && before.label === label && sameBox(before.box, box);
    const change = is_track_only ? { kind: "track", uid: id, track_id } : { kind: "edit", uid: id, label, box, track_id };
    const error = await send([change], id);
    if (draft.sending === wanted) draft.sending = null;
    draft.problem = error?.message ?? null;
    if (!error && draft.wanted === wanted && drafts.get(id) === draft) drafts.delete(id);
    tell("draft");
    return !error;
  }

  function revert(id = uid) {
    if (added.has(id) && !drafts.has(id)) remove(id);
    drafts.delete(id);
    tell("draft");
  }

  const retry = (id) => (added.has(id) ? create(id) : drafts.has(id) ? save(id) : Promise.resolve(true));

  /** A label as the operator sees it: with its draft's box, class and track. */
  function seen(label) {
    const draft = label && drafts.get(label.uid);
    return draft ? { ...label, ...draft.wanted } : label;
  }

  return {
    get uid() {
      return uid;
    },
    get isSaving() {
      return waiting > 0;
    },
    get hasDraft() {
      return drafts.has(uid);
    },
    labels,
    stored,
    seen,

    /** The selected label as the operator sees it, or null. */
    get shown() {
      return seen(stored());
    },

    /** Whether a label has a draft, and why that could not be saved, if it was tried. */
    isDraft: (id) => drafts.has(id),
    problemOf: (id = uid) => drafts.get(id)?.problem ?? added.get(id)?.problem ?? null,

    /** A box that was found in what was drawn on the image: {label, box, outline, points, score, quality, image_box}. */
    add({ image_box, ...found }) {
      keep();
      uid = `new-${(number += 1)}`;
      const label = { ...found, uid, is_new: true, state: "proposed", source: "drawn", author: app.state.operator, track_id: null, doubt: null };
      added.set(uid, { label, image_box, actions: 1, problem: null, sending: null });
      tell("selection");
    },

    /** What is lost where the page is left now; null where all is saved. */
    get unsaved() {
      const changed = [...drafts.keys()].filter((id) => !added.has(id)).length;
      if (changed === 0 && added.size === 0 && waiting === 0) return null;
      const problems = [...drafts.values(), ...added.values()].map(({ problem }) => problem).filter(Boolean);
      const what = [changed && count(changed, "changed box", "changed boxes"), added.size && `${count(added.size, "new box", "new boxes")} that nobody has accepted`];
      return { text: `Not saved: ${what.filter(Boolean).join(", ")}. ${[...new Set(problems)].join(" ")}`.trim() };
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
      const draft = drafts.get(uid) ?? { sending: null, problem: null };
      const base = draft.wanted ?? { label: label.label, track_id: label.track_id, box: copyBox(label.box) };
      draft.wanted = { ...base, ...changes };
      if (draft.sending || isChanged(label, draft.wanted)) drafts.set(uid, draft);
      else drafts.delete(uid);
      tell("draft");
    },
    commit,
    revert,

    /** Shows and saves in one go. */
    edit(changes) {
      this.preview(changes);
      return commit();
    },

    /** Saves what could not be saved, or nobody has accepted: one box, or all. */
    retry: (id = uid) => retry(id),
    retryAll: () => Promise.all([...new Set([...drafts.keys(), ...added.keys()])].map(retry)),
    discardAll() {
      forget();
      if (!stored()) uid = null;
      tell("frame");
    },

    /** One of {kind: "accept" | "reject" | "delete"} for a label. */
    async decide(kind, id) {
      if (added.has(id)) return kind === "accept" ? create(id) : remove(id);
      app.effort.action();
      // a box that is no object, or goes, needs no mending
      const draft = drafts.get(id);
      if (kind !== "accept") drafts.delete(id);
      const error = await send([{ kind, uid: id }], id);
      if (error && draft && stored(id) && !drafts.has(id)) drafts.set(id, draft);
      return !error;
    },

    /** Finalises the frame, or opens it again. */
    async finalise(on) {
      app.effort.action();
      return !(await send([{ kind: on ? "finalise" : "reopen" }], null));
    },

    /** The reviewed boxes of the frame before, as far as this one lacks them; resolves to how many there were. */
    copyPrevious() {
      const { id } = app.state.frame.frame;
      app.effort.action();
      return enqueue(async () => {
        const before = labels().length;
        const copy = () => app.api.change(app.path("frames", id, "copy"), { revision: app.state.frame.frame.revision, from: null });
        try {
          app.frames.take(await copy());
        } catch (error) {
          if (!error.isStale) throw error;
          // boxes are only added, so nothing of somebody else's can be lost
          app.frames.take(error.body.state);
          app.frames.take(await copy());
        }
        return labels().length - before;
      });
    },

    /** What others have saved of this frame; after one's own changes, whose answers may bring it along. */
    refresh: () => (app.frames.isBehind ? enqueue(() => app.frames.refresh()) : Promise.resolve()),

    /** Waits until everything is saved. */
    flush() {
      keep();
      return chain;
    },
  };
}
