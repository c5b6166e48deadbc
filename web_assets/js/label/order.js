/** Which frame is next: the most useful one for training, or the next in time. */

const KEPT = "label-order";

/** @param {App} app */
export function createOrder(app) {
  /** @type {number[]} */
  const visited = [];
  /** @type {number | null} */
  let remaining = null;
  /** @type {OrderName} */
  let by = localStorage.getItem(KEPT) === "time" ? "time" : "teach";

  /** @param {RequestOptions} [options] */
  async function teaching(options) {
    const current = app.state.frame?.frame.id ?? null;
    /** @type {Api.QueueOut} */
    const { items, remaining: count } = await app.api.get(`${app.path("queue")}?order=teach`, options);
    remaining = count;
    const others = items.map(({ frame }) => frame).filter((frame) => frame !== current);
    return (
      others.find((frame) => !visited.includes(frame)) ?? others.find((frame) => frame !== visited.at(-1)) ?? null
    );
  }

  async function firstFrame() {
    /** @type {Api.FrameListJson} */
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
    /** The number of frames in the queue at the latest request; null before the first one. */
    get remaining() {
      return remaining;
    },
    /**
     * The id of the first frame, or of the next one; null if there is none. Does not open it.
     *
     * @param {RequestOptions} [options]
     */
    async next(options) {
      if (by === "time" && app.state.frame) return app.state.frame.frame.next;
      return (
        (by === "teach" ? await teaching(options) : null) ??
        (app.state.frame ? app.state.frame.frame.next : firstFrame())
      );
    },
    /** The id of the previous frame in time, or of the one that was open before. */
    previous() {
      const current = app.state.frame?.frame;
      if (by === "time" || visited.length < 2) return current?.previous ?? null;
      visited.pop();
      return visited.pop() ?? null;
    },
    /**
     * Records that a frame was opened.
     *
     * @param {number} frame
     */
    opened(frame) {
      if (visited.at(-1) !== frame) visited.push(frame);
      if (visited.length > 500) visited.shift();
    },
  };
}
