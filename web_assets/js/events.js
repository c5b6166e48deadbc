/** The server's live messages, over one WebSocket, which is reopened whenever the connection is lost. */

const FIRST_WAIT_MS = 400;
const LONGEST_WAIT_MS = 8000;

/** See `Messages` for the types of messages and their contents. */
export function createEvents() {
  /** @type {Map<string, Set<(message: never) => unknown>>} */
  const listeners = new Map();
  /** @type {WebSocket | null} */
  let socket = null;
  /** @type {string | null} */
  let project = null;
  /** @type {number | null} */
  let shownFrame = null;
  let waitMs = FIRST_WAIT_MS;
  let timer = 0;
  let wasConnected = false;

  /**
   * @template {keyof Messages} K
   * @param {K} type
   * @param {Messages[K]} message
   */
  function emit(type, message) {
    for (const fn of [...(listeners.get(type) ?? [])]) fn(/** @type {never} */ (message));
  }

  /** @param {string} name */
  function connect(name) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const mine = new WebSocket(`${scheme}://${location.host}/api/events?project=${encodeURIComponent(name)}`);
    socket = mine;
    mine.onopen = () => {
      waitMs = FIRST_WAIT_MS;
      emit("connection", true);
      if (shownFrame !== null) send({ type: "open", project, frame: shownFrame });
      if (wasConnected) emit("reconnected", null);
      wasConnected = true;
    };
    mine.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      emit(message.type, message);
    };
    mine.onclose = () => {
      if (socket !== mine) return;
      emit("connection", false);
      timer = setTimeout(connect, waitMs, name);
      waitMs = Math.min(waitMs * 2, LONGEST_WAIT_MS);
    };
  }

  /** @param {object} message */
  function send(message) {
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  }

  return {
    /**
     * Calls `fn(message)` for each message of a type. Returns a function that removes this listener.
     *
     * @template {keyof Messages} K
     * @param {K} type
     * @param {(message: Messages[K]) => unknown} fn
     */
    on(type, fn) {
      const known = listeners.get(type) ?? new Set();
      listeners.set(type, known.add(fn));
      return () => known.delete(fn);
    },

    /**
     * Receives the messages of a project; null: receives no messages.
     *
     * @param {string | null} name
     */
    follow(name) {
      if (name === project) return;
      project = name;
      shownFrame = null;
      wasConnected = false;
      clearTimeout(timer);
      const old = socket;
      socket = null;
      old?.close();
      if (name !== null) connect(name);
    },

    /**
     * Reports to the other pages which frame is open on this page; null: no frame is open.
     *
     * @param {number | null} frame
     */
    openFrame(frame) {
      shownFrame = frame;
      send(frame === null ? { type: "close" } : { type: "open", project, frame });
    },
  };
}
