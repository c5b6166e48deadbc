/**
 * The state of Annotate, without any display: the selected box, unsaved edits, and the changes that are sent to the
 * server one after the other.
 *
 * A box that is being dragged is a draft: `preview` shows it everywhere without a request, `commit` saves it as one
 * edit. A draft that could not be saved is kept until it is saved or reverted, even if another box is selected. A new
 * box exists only on this page until it is accepted; its effort is counted then. Listeners are called with a
 * `DeskEvent`.
 */

import { schemaOf } from "../attributes.js";
import { carried, copyBox, fillSame, sameBox } from "../box3d.js";
import { count } from "../dom.js";
import { messageOf } from "../errors.js";
import { currentFrame } from "../frame_state.js";
import { frameName } from "../timeline/reading.js";
import { createSender } from "./saver.js";
import { changesOn, chooseBox, versionOf } from "./versions.js";

/** True if a label has not been reviewed yet. */
export const isOpen = (/** @type {{ state: Api.ReviewState }} */ label) => label.state === "proposed";

/** What a corrected box encloses: the whole object, but one that was only turned encloses what it did. */
const kindOf = (/** @type {PageLabel | null} */ before, /** @type {Box3D} */ box) =>
  before && fillSame(before.box, box) ? null : "box";

export function createDesk(/** @type {App} */ app) {
  /** @type {Set<(what: DeskEvent) => unknown>} */
  const listeners = new Set();
  /** Drafts by uid, of boxes of the moment of the frame `home`, whose camera sees them so. @type {Map<string | null, LabelDraft>} */
  const drafts = new Map();
  /** New boxes by uid, of the same moment. @type {Map<string | null, NewLabel>} */
  const added = new Map();
  let number = 0;
  /** @type {number | null} */
  let home = null;
  /** That of its camera at the cloud. @type {Matrix | null} */
  let pose = null;
  /** @type {string | null} */
  let uid = null;
  /** Whether changes of the selected box, whose object stands still, are for this frame only. */
  let isHere = false;
  /** The number of changes on their way that may change other frames, too. */
  let wide = 0;
  /** @type {Set<() => void>} */
  const leaving = new Set();
  const sender = createSender(app, () => notify("saving"));

  function notify(/** @type {DeskEvent} */ what) {
    for (const fn of listeners) fn(what);
  }

  /** @returns {PageLabel[]} */
  const labels = () => [...(app.state.frame?.labels ?? []), ...[...added.values()].map(({ label }) => label)];
  const stored = (id = uid) => labels().find((label) => label.uid === id) ?? null;

  const isStill = (/** @type {string | null | undefined} */ id) => stored(id ?? null)?.still === true;

  /**
   * Waits for a change that other frames show, too: what was read of them ahead is read again.
   *
   * @template T
   * @param {Promise<T>} sending
   */
  async function widely(sending) {
    wide += 1;
    try {
      return await sending;
    } finally {
      wide -= 1;
      app.frames.giveUp();
    }
  }

  /** Sends a change of the open frame, and perhaps of others. */
  function change(/** @type {FrameChange} */ what, isWide = true) {
    app.effort.action();
    const sending = sender.send(currentFrame(app).frame.id, what);
    return isWide ? widely(sending) : sending;
  }

  /** Sends changes of the open frame; resolves to null if they are saved, else to the problem. */
  async function send(/** @type {Change[]} */ changes, /** @type {string | null} */ subject) {
    try {
      const sending = sender.send(currentFrame(app).frame.id, changeOf(changes, subject));
      await (changes.some(({ uid: of, here }) => !here && isStill(of)) ? widely(sending) : sending);
      rebase(changes);
      return null;
    } catch (error) {
      app.toast(error);
      return messageOf(error);
    }
  }

  /** @returns {FrameChange<Answer<"POST", ProjectPath<["frames", number, "changes"]>>>} */
  function changeOf(/** @type {Change[]} */ changes, /** @type {string | null} */ subject) {
    return {
      path: ["changes"],
      body: (state) => changesOn(state, changes, subject),
      mine: (theirs) => versionOf(theirs, changes),
      // others may have changed a box while this page had a draft of it: then the operator chooses
      base: () =>
        changes.map(({ uid: of }) => drafts.get(of ?? null)).find((draft) => draft && isBehind(draft))?.revision,
      async instead(error, state) {
        const { id, key } = state.frame;
        const name = app.state.frame?.frame.id === id ? undefined : frameName(app.state, id, key);
        const choice = await chooseBox(state.labels, changes, error, name);
        if (choice === null) throw error;
        if (choice.selected && stored(choice.selected)) select(choice.selected);
        return choice.changes.length > 0 ? changeOf(choice.changes, subject) : null;
      },
      done({ moved }) {
        if (!(moved > 0)) return;
        app.frames.giveUp();
        app.toast(`${count(moved, "unreviewed box", "unreviewed boxes")} of the track moved along.`);
      },
    };
  }

  /** To be called after each new state of the frame: the selected box may be gone, and drafts may be saved. */
  function settle() {
    const { id, cameras, T_camera_cloud: there } = currentFrame(app).frame;
    if (id !== home && home !== null && Object.values(cameras).includes(home)) carry(there);
    else if (id !== home) forget();
    home = id;
    pose = there;
    for (const gone of [...drafts.keys()].filter((known) => !stored(known))) {
      // if a draft is being sent, the answer to it reports the outcome
      const mustNotify = !drafts.get(gone)?.sending;
      drafts.delete(gone);
      if (mustNotify) app.toast("The box that you were changing was deleted elsewhere.", "warn");
    }
    if (uid !== null && !stored()) uid = null;
    notify("frame");
  }

  /** Another camera of the moment was opened: it sees the same boxes. */
  function carry(/** @type {Matrix | null} */ there) {
    const move = (/** @type {Box3D} */ box) => carried(box, pose, there);
    for (const { wanted, base } of drafts.values()) for (const each of [wanted, base]) each.box = move(each.box);
    for (const entry of added.values()) {
      entry.label = { ...entry.label, box: move(entry.label.box), outline: [] };
      entry.found = move(entry.found);
    }
  }

  function forget() {
    drafts.clear();
    added.clear();
  }

  /** Saves the selected box's draft, unless saving it has failed before. */
  function keep() {
    for (const fn of leaving) fn();
    const draft = drafts.get(uid);
    if (draft && !draft.problem && draft.sending !== draft.wanted) void commit();
  }

  function select(/** @type {string | null} */ id) {
    if (id === uid) return;
    keep();
    uid = id;
    isHere = drafts.get(id)?.here ?? false;
    notify("selection");
  }

  const isChanged = (/** @type {PageLabel} */ label, /** @type {Wanted} */ wanted) =>
    label.label !== wanted.label || label.track_id !== wanted.track_id || !sameBox(label.box, wanted.box);

  const valuesOf = (/** @type {PageLabel} */ { label, track_id, box }) => ({ label, track_id, box: copyBox(box) });

  /** Whether the stored label is no longer that of which a draft was made. */
  function isBehind(/** @type {LabelDraft} */ { base }) {
    const label = stored(base.uid);
    return label !== null && isChanged(label, base);
  }

  /** Drafts of labels that this page has just saved are drafts of what is stored now. */
  function rebase(/** @type {Change[]} */ changes) {
    for (const { uid: of } of changes) {
      const [draft, label] = [drafts.get(of ?? null), stored(of)];
      if (!draft || !label) continue;
      draft.base = { uid: label.uid, ...valuesOf(label) };
      draft.revision = currentFrame(app).frame.revision;
    }
  }

  /** Saves the selected box's draft, if there is one, as one edit that took this many actions. */
  async function commit(actions = 1) {
    const draft = drafts.get(uid);
    if (!draft || !stored()) return true;
    if (added.has(uid)) return applyDraft(uid, actions);
    if (draft.sending === draft.wanted) return draft.sent;
    app.effort.action(actions);
    draft.here = isHereOnly(uid);
    return save(uid, draft);
  }

  /** Applies the draft of a new box, which only this page has. */
  function applyDraft(/** @type {string | null} */ id, /** @type {number} */ actions) {
    const entry = added.get(id);
    if (!entry) return true;
    entry.label = seen(entry.label);
    entry.actions += actions;
    drafts.delete(id);
    notify("draft");
    return true;
  }

  /** The box on the open image in which a new box was found, or null. */
  function imageBox(/** @type {string | null} */ id) {
    const entry = added.get(id);
    return entry && entry.frame === home ? entry.image_box : null;
  }

  /** Accepts a new box, which stores it. It is stored once, even if it is accepted again before the answer. */
  function create(/** @type {string | null} */ id, /** @type {NewLabel} */ entry) {
    entry.sending ??= storeNew(id, entry).finally(() => {
      entry.sending = null;
    });
    return entry.sending;
  }

  async function storeNew(/** @type {string | null} */ id, /** @type {NewLabel} */ entry) {
    // completes an edit by arrow keys that were pressed just before
    if (uid === id) for (const fn of leaving) fn();
    applyDraft(id, 1);
    const { label, box, track_id, suggestion: given } = entry.label;
    const suggestion = given && { ...given, corrected: !sameBox(box, entry.found) };
    const known = new Set(labels().map((one) => one.uid));
    app.effort.action(entry.actions);
    /** @type {Change} */
    const change = { kind: "create", label, box, track_id, image_box: imageBox(id), suggestion };
    const error = await send([change], null);
    entry.problem = error;
    // the next try counts its own effort
    if (error) entry.actions = 0;
    else added.delete(id);
    if (!error && uid === id) uid = labels().find((one) => !known.has(one.uid))?.uid ?? null;
    notify(error ? "draft" : "selection");
    return !error;
  }

  function remove(/** @type {string | null} */ id) {
    added.delete(id);
    drafts.delete(id);
    if (uid === id) uid = null;
    notify("selection");
    return true;
  }

  const isHereOnly = (/** @type {string | null} */ id) => isHere && id === uid && isStill(id);

  function save(/** @type {string | null} */ id, /** @type {LabelDraft} */ draft) {
    draft.sent = sendDraft(id ?? "", draft);
    return draft.sent;
  }

  async function sendDraft(/** @type {string} */ id, /** @type {LabelDraft} */ draft) {
    const { wanted, here } = draft;
    draft.sending = wanted;
    const { label, box, track_id } = wanted;
    const before = stored(id);
    // another track id does not change the box, so its review stays valid
    const isTrackOnly = before && before.label === label && sameBox(before.box, box);
    /** @type {Change} */
    const change = isTrackOnly
      ? { kind: "track", uid: id, track_id }
      : { kind: "edit", uid: id, label, box, track_id, box_kind: kindOf(before, box), here };
    const error = await send([change], id);
    if (draft.sending === wanted) draft.sending = null;
    draft.problem = error;
    if (!error && draft.wanted === wanted && drafts.get(id) === draft) drafts.delete(id);
    notify("draft");
    return !error;
  }

  function revert(/** @type {string | null} */ id = uid) {
    if (added.has(id) && !drafts.has(id)) remove(id);
    drafts.delete(id);
    notify("draft");
  }

  function retry(/** @type {string | null} */ id) {
    const [entry, draft] = [added.get(id), drafts.get(id)];
    if (entry) return create(id, entry);
    return draft ? save(id, draft) : Promise.resolve(true);
  }

  /** A label as shown: with its draft's box, class and track. @returns {PageLabel} */
  function seen(/** @type {PageLabel} */ label) {
    const draft = drafts.get(label.uid);
    return draft ? { ...label, ...draft.wanted } : label;
  }

  return {
    get uid() {
      return uid;
    },
    get isSaving() {
      return sender.waiting > 0;
    },
    get hasDraft() {
      return drafts.has(uid);
    },
    labels,
    stored,
    seen,

    /** The selected label as shown, or null. */
    get shown() {
      const label = stored();
      return label && seen(label);
    },

    get isHere() {
      return isHere;
    },
    setHere(/** @type {boolean} */ on) {
      isHere = on;
    },

    isDraft: (/** @type {string} */ id) => drafts.has(id),
    /** The box on the image in which a new box was found, or null. */
    imageBox,
    /** The reason why a label could not be saved, or null. */
    problemOf: (id = uid) => drafts.get(id)?.problem ?? added.get(id)?.problem ?? null,

    /**
     * Adds a new box: the object found in the box that was drawn on the image.
     *
     * @param {Pick<PageLabel, "label" | "box" | "outline" | "points" | "score" | "quality" |
     *     "measured_by" | "suggestion"> &
     *     Pick<NewLabel, "image_box">} fit
     */
    add({ image_box, ...fit }) {
      keep();
      number += 1;
      uid = `new-${number}`;
      /** @type {PageLabel} */
      const label = {
        ...fit,
        uid,
        isNew: true,
        box_kind: "box",
        state: "proposed",
        source: "drawn",
        author: app.state.operator,
        track_id: null,
        said: [],
        doubt: null,
        attributes: {},
        kept: false,
        heading_beside: null,
        seen_by: [],
        better_in: null,
        still: false,
      };
      added.set(uid, { label, image_box, frame: home, found: fit.box, actions: 1, problem: null, sending: null });
      notify("selection");
    },

    /** What would be lost if the page were left now; null if everything is saved. @returns {Unsaved | null} */
    get unsaved() {
      const changed = [...drafts.keys()].filter((id) => !added.has(id)).length;
      if (changed === 0 && added.size === 0 && sender.waiting === 0) return null;
      const problems = [...drafts.values(), ...added.values()].map(({ problem }) => problem).filter(Boolean);
      const what = [
        changed && count(changed, "changed box", "changed boxes"),
        added.size && count(added.size, "new box, not accepted yet", "new boxes, not accepted yet"),
        changed === 0 && added.size === 0 && "what is being sent",
      ];
      return {
        text: `Not saved: ${what.filter(Boolean).join(", ")}. ${[...new Set(problems)].join(" ")}`.trim(),
        retry: () => Promise.all([...new Set([...drafts.keys(), ...added.keys()])].map(retry)),
        discard() {
          forget();
          if (!stored()) uid = null;
          notify("frame");
        },
      };
    },

    /** Calls `fn(what)` after changes. Returns a function that removes this listener. */
    on(/** @type {(what: DeskEvent) => unknown} */ fn) {
      listeners.add(fn);
      return () => listeners.delete(fn);
    },

    select,
    /** Adds a function that ends an edit in progress of the selected box, called before another box is selected. */
    onLeave(/** @type {() => void} */ fn) {
      leaving.add(fn);
    },
    settle,
    enqueue: sender.enqueue,
    send: sender.send,
    change,
    /**
     * Whether another frame may be opened before what waits, and a decision on a box, is saved: no box is not sent, and
     * none of that changes the other frame.
     */
    mayGoOn: (/** @type {number} */ frame, /** @type {string} */ id) =>
      drafts.size === 0 && added.size === 0 && wide === 0 && !isStill(id) && !sender.isOf(frame),
    /** Whether a new box is as it was found. */
    isAsFound: (/** @type {string | null} */ id) => added.get(id)?.actions === 1 && !drafts.has(id),
    /** Removes a new box, which another object replaces. */
    drop: remove,

    /** Shows the selected label with other values, without saving them. */
    preview(/** @type {Partial<Wanted>} */ changes) {
      const label = stored();
      if (!label) return;
      const draft = drafts.get(uid) ?? {
        wanted: valuesOf(label),
        base: { uid: label.uid, ...valuesOf(label) },
        revision: currentFrame(app).frame.revision,
        here: false,
        sending: null,
        sent: Promise.resolve(true),
        problem: null,
      };
      draft.wanted = { ...draft.wanted, ...changes };
      if (draft.sending || isChanged(label, draft.wanted)) drafts.set(uid, draft);
      else drafts.delete(uid);
      notify("draft");
    },
    commit,
    revert,

    /** Shows the selected label with other values, and saves them. */
    edit(/** @type {Partial<Wanted>} */ changes) {
      this.preview(changes);
      return commit();
    },

    /** Saves a box that could not be saved or is not accepted. */
    retry: (id = uid) => retry(id),
    /** Accepts, rejects or deletes a label. */
    async decide(/** @type {"accept" | "reject" | "delete"} */ kind, /** @type {string} */ id) {
      const entry = added.get(id);
      if (entry) return kind === "accept" ? create(id, entry) : remove(id);
      app.effort.action();
      // a rejected or deleted box needs no correction
      const draft = drafts.get(id);
      if (kind !== "accept") drafts.delete(id);
      const here = isHereOnly(id);
      const isEverywhere = kind !== "accept" && !here && stored(id)?.still === true;
      const error = await send([{ kind, uid: id, here }], id);
      const done = kind === "reject" ? "rejected" : "deleted";
      if (!error && isEverywhere) app.toast(`The object stands still: it was ${done} in all frames.`);
      if (error && draft && stored(id) && !drafts.has(id)) drafts.set(id, draft);
      return !error;
    },

    /** Accepts the stored proposals that the camera shows, as one action. */
    async acceptAll() {
      const open = (app.state.frame?.labels ?? []).filter((label) => isOpen(label) && label.better_in === null);
      app.effort.action();
      return (
        open.length === 0 ||
        !(await send(
          open.map((label) => ({ kind: "accept", uid: label.uid })),
          null,
        ))
      );
    },

    /** Finalises the frame, or reopens it. */
    async finalise(/** @type {boolean} */ on) {
      app.effort.action();
      return !(await send([{ kind: on ? "finalise" : "reopen" }], null));
    },

    /** Sets values of attributes of a label, or (null) of the frame. */
    setValues(
      /** @type {string | null} */ id,
      /** @type {Record<string, string | number | boolean | null>} */ values,
    ) {
      // sent again without asking: only these values change
      const what = { path: ["attributes"], body: () => ({ uid: id, values }), isSentAgain: true };
      const isOfTrack = schemaOf(app).some(({ name, of }) => of === "track" && name in values);
      return change(what, isOfTrack || isStill(id)).catch((error) => {
        app.toast(error);
        notify("frame");
      });
    },

    /** Copies reviewed boxes of the previous frame that this one lacks, as proposals; resolves to them. */
    async copyPrevious() {
      let before = labels();
      const body = () => {
        before = labels();
        return {};
      };
      // sent again without asking: the others' reviewed boxes stay
      await change({ path: ["copy"], body, isSentAgain: true });
      return labels().filter(({ uid }) => before.every((known) => known.uid !== uid));
    },

    /**
     * Gives unsaved boxes the new names of their classes.
     *
     * @param {Record<string, string>} renamed old name -> new name.
     */
    rename(renamed) {
      for (const { wanted, base } of drafts.values())
        for (const each of [wanted, base]) each.label = renamed[each.label] ?? each.label;
      for (const entry of added.values()) {
        const label = renamed[entry.label.label] ?? entry.label.label;
        entry.label = { ...entry.label, label };
        entry.image_box = entry.image_box && { ...entry.image_box, label };
      }
      notify("draft");
    },

    /** Reads what others have saved, after all changes of this page, whose answers may already include it. */
    refresh: () => (app.frames.isBehind ? sender.enqueue(() => app.frames.refresh()) : Promise.resolve()),

    /** Waits until everything is saved, also what is added meanwhile. */
    async flush() {
      keep();
      await sender.idle();
    },
  };
}
