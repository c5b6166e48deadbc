/** The queue of proposals to review: its order, its filter, and what comes after the one that was just decided. */

export const ORDERS = [
  ["worst", "Worst first"],
  ["time", "In time order"],
  ["class", "By class"],
  ["track", "By track"],
];

/** Another operator's work is read in after this pause, milliseconds. */
const CALM_MS = 1500;
/** The server sends the first few hundred items; more are read when so few of them are left. */
const FEW = 100;

export function createQueue(app, onChange) {
  let order = ORDERS.some(([name]) => name === localStorage.getItem("queue-order")) ? localStorage.getItem("queue-order") : "worst";
  let label = "";
  let items = [];
  let remaining = 0;
  let place = 0;
  let timer = 0;
  let ended = false;

  async function load() {
    const query = new URLSearchParams({ order, ...(label && { label }) });
    const answer = await app.api.get(`${app.path("queue")}?${query}`);
    if (ended) return;
    items = answer.items.filter(({ uid }) => uid !== null);
    remaining = answer.remaining;
    place = Math.min(place, items.length);
    onChange();
  }

  return {
    load,
    get items() {
      return items;
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

    /** Another order or class; starts at its beginning. */
    async choose(changes) {
      ({ order, label } = { order, label, ...changes });
      localStorage.setItem("queue-order", order);
      place = 0;
      await load();
    },

    /** Remembers where the operator is, so that what follows is known when this item is gone. */
    visit(uid) {
      const index = items.findIndex((item) => item.uid === uid);
      if (index >= 0) place = index;
    },

    /** The next item to decide after the one at hand, or null. */
    after(uid) {
      const index = items.findIndex((item) => item.uid === uid);
      const others = index >= 0 ? [...items.slice(index + 1), ...items.slice(0, index)] : [...items.slice(place), ...items.slice(0, place)];
      return others[0] ?? null;
    },

    /** Takes out what a frame's new state says is decided. */
    settle(frame) {
      const open = new Set(frame.labels.filter(({ state }) => state === "proposed").map(({ uid }) => uid));
      const gone = (item) => item.frame === frame.frame.id && !open.has(item.uid);
      const before = items.length;
      place -= items.slice(0, place).filter(gone).length;
      items = items.filter((item) => !gone(item));
      remaining = Math.max(items.length, remaining - (before - items.length));
      const known = new Set(items.map(({ uid }) => uid));
      // an undo brings proposals back
      const comes_back = !label && [...open].some((uid) => !known.has(uid));
      if (comes_back || (items.length < FEW && items.length < remaining)) this.reloadSoon();
      if (items.length !== before) onChange();
    },

    reloadSoon() {
      clearTimeout(timer);
      timer = setTimeout(() => load().catch(app.toast), CALM_MS);
    },

    end() {
      ended = true;
      clearTimeout(timer);
    },
  };
}
