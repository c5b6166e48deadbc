/** The queue of proposals to review, or of frames to draw on: its order, its filter, and the next item. */

import { withQuery } from "../api.js";

export const ORDERS = [
  ["worst", "Most doubtful first"],
  ["time", "In time order"],
  ["class", "By class"],
  ["track", "By track"],
  ["teach", "Frames that teach most"],
];

/** The source of our own proposals. */
export const OWN = "annotator";

/** The queue is read again this long after a change by others, also while more of them come. */
const CALM_MS = 1500;
/** The server sends a few hundred items; more are read when fewer than these are left. */
const FEW = 100;

export function createQueue(/** @type {App} */ app, /** @type {() => void} */ onChange) {
  const kept = localStorage.getItem("queue-order");
  let order = ORDERS.find(([name]) => name === kept)?.[0] ?? "worst";
  let label = "";
  /** What is asked of the values of an attribute, as the server's query has it; nothing: all. @type {ValueQuery} */
  let value = {};
  /** The source whose objects are shown; "": all. */
  let source = "";
  /** The number of objects that each source sees. @type {Record<string, number>} */
  let sources = {};
  /** @type {QueueItem[]} */
  let items = [];
  /** Items that were reviewed, for an undo. @type {Map<string | null, QueueItem>} */
  const reviewed = new Map();
  let remaining = 0;
  /** How often something was chosen, and up to which choice the items are the answer. */
  let [choices, answered] = [0, 0];
  let place = 0;
  let timer = 0;
  let ended = false;

  async function load() {
    const query = { order, ...(label ? { label } : {}), ...value, ...(source ? { source } : {}) };
    const own = choices;
    const answer = await app.api.get(withQuery(app.path("queue"), query));
    if (ended || own !== choices) return;
    answered = own;
    items = answer.items;
    const hasMore = answer.remaining > remaining;
    remaining = answer.remaining;
    place = Math.min(place, items.length);
    onChange();
    const hasOthers = Object.keys(sources).some((name) => name !== OWN);
    // not waited for: it takes longer than the queue
    if (hasMore || hasOthers) loadSources().catch(app.toast);
  }

  /** Takes out items that are reviewed; an undo brings them back. */
  function remove(/** @type {(item: QueueItem) => boolean} */ isGone) {
    place -= items.slice(0, place).filter(isGone).length;
    const gone = items.filter(isGone);
    for (const item of gone) reviewed.set(item.uid, item);
    items = items.filter((item) => !isGone(item));
    remaining = Math.max(items.length, remaining - gone.length);
    return gone.length;
  }

  async function loadSources() {
    sources = await app.api.get(app.path("queue", "sources"));
    if (!ended) onChange();
  }

  return {
    load,
    get items() {
      return items;
    },
    /** Another number where the items are those of another choice. */
    get answered() {
      return answered;
    },
    get remaining() {
      return remaining;
    },
    get order() {
      return order;
    },
    get label() {
      return label;
    },
    get sources() {
      return sources;
    },
    /** True if proposals may wait that are not shown. */
    get isFiltered() {
      return Boolean(label || value.attribute || source);
    },

    /** Chooses another order or filter, and starts at the beginning of the queue. */
    async choose(/** @type {{ order?: string, label?: string, value?: ValueQuery, source?: string }} */ changes) {
      order = changes.order ?? order;
      label = changes.label ?? label;
      value = changes.value ?? value;
      source = changes.source ?? source;
      localStorage.setItem("queue-order", order);
      place = 0;
      choices += 1;
      reviewed.clear();
      await load();
    },

    /** Remembers the operator's place, so that the next item is known when this one is gone. */
    visit(/** @type {string | null} */ uid) {
      const index = items.findIndex((item) => item.uid === uid);
      if (index >= 0) place = index;
    },

    /** The next item after this box, or, while the queue has frames to draw on, after this frame; or null. */
    after(/** @type {string | null} */ uid, /** @type {number | null} */ frame = null) {
      const index = items.findIndex((item) => (item.uid === null ? item.frame === frame : item.uid === uid));
      const others =
        index >= 0
          ? [...items.slice(index + 1), ...items.slice(0, index)]
          : [...items.slice(place), ...items.slice(0, place)];
      return others[0] ?? null;
    },

    /** Removes an item that the operator has decided on, before that is saved. */
    leave(/** @type {string} */ uid) {
      if (remove((item) => item.uid === uid) > 0) onChange();
    },

    /** Removes the items that are reviewed in a frame's new state; those that an undo has opened again come back. */
    settle(/** @type {FrameState} */ frame) {
      if (order === "teach") return this.reloadSoon();
      const proposals = frame.labels.filter(({ state }) => state === "proposed");
      /** @type {Set<string | null>} */
      const open = new Set(proposals.map(({ uid }) => uid));
      // a label belongs to its moment, whose frames have the same
      const moment = new Set(Object.values(frame.frame.cameras).concat(frame.frame.id));
      const gone = (/** @type {QueueItem} */ item) => moment.has(item.frame) && !open.has(item.uid);
      const removed = remove(gone);
      const known = new Set(items.map(({ uid }) => uid));
      const back = [...reviewed.values()].filter(({ uid }) => open.has(uid) && !known.has(uid));
      for (const { uid } of back) reviewed.delete(uid);
      items = items.toSpliced(place, 0, ...back);
      remaining += back.length;
      // an undo may restore proposals that are not known here; one that stands still waits in one frame only
      const comesBack = !this.isFiltered && proposals.some(({ uid, still }) => !still && !known.has(uid));
      if (comesBack || (items.length < FEW && items.length < remaining)) this.reloadSoon();
      if (removed > 0 || back.length > 0) onChange();
    },

    reloadSoon() {
      if (timer || ended) return;
      timer = setTimeout(() => {
        timer = 0;
        load().catch(app.toast);
      }, CALM_MS);
    },

    end() {
      ended = true;
      clearTimeout(timer);
    },
  };
}
