/** Which frame comes next: the one that teaches most, or the next in time. */

const KEPT = "label-order";

export function createOrder(app) {
  const visited = [];
  let remaining = null;
  let by = localStorage.getItem(KEPT) === "time" ? "time" : "teach";

  async function teaching(options) {
    const current = app.state.frame?.frame.id ?? null;
    const { items, remaining: count } = await app.api.get(`${app.path("queue")}?order=teach`, options);
    remaining = count;
    const others = items.map(({ frame }) => frame).filter((frame) => frame !== current);
    return others.find((frame) => !visited.includes(frame)) ?? others.find((frame) => frame !== visited.at(-1)) ?? null;
  }

  async function firstFrame() {
    const { frames } = await app.api.get(`${app.path("frames")}?limit=1`);
    return frames[0]?.id ?? null;
  }

  return {
    get by() {
      return by;
    },
    set by(value) {
      by = value;
      localStorage.setItem(KEPT, value);
    },
    /** How many frames the queue had when it was last asked; null before. */
    get remaining() {
      return remaining;
    },
    /** The frame to begin with, or to go to next; null where there is none. To ask is not to go. */
    async next(options) {
      if (by === "time" && app.state.frame) return app.state.frame.frame.next;
      return (by === "teach" ? await teaching(options) : null) ?? (app.state.frame ? app.state.frame.frame.next : firstFrame());
    },
    /** Back in time, or to where one came from. */
    previous() {
      const current = app.state.frame?.frame;
      if (by === "time" || visited.length < 2) return current?.previous ?? null;
      visited.pop();
      return visited.pop();
    },
    /** A frame was opened. */
    opened(frame) {
      if (visited.at(-1) !== frame) visited.push(frame);
      if (visited.length > 500) visited.shift();
    },
  };
}
