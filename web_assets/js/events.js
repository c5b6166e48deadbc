/** The server's live messages, over one WebSocket, which is reopened whenever the connection is lost. */

const FIRST_WAIT_MS = 400;
const LONGEST_WAIT_MS = 8000;
// A page does not wait longer for the first connection; it reads everything again once it is connected.
const FIRST_CONNECTION_MS = 2000;

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
  /** Whether the page may have read something before it was connected. */
  let hasRead = false;
  let onFirst = () => {};
  let ready = Promise.resolve();

  /**
   * @template {keyof Messages} K
   * @param {K} type
   * @param {Messages[K]} message
   */
  function emit(type, message) {
    for (const fn of [...(listeners.get(type) ?? [])]) fn(/** @type {never} */ (message));
  }

  function connect(/** @type {string} */ name) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const mine = new WebSocket(`${scheme}://${location.host}/api/events?project=${encodeURIComponent(name)}`);
    socket = mine;
    mine.onopen = () => {
      waitMs = FIRST_WAIT_MS;
      emit("connection", true);
      if (shownFrame !== null) send({ type: "open", frame: shownFrame });
      if (hasRead) emit("reconnected", null);
      hasRead = true;
      onFirst();
    };
    mine.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      emit(message.type, message);
    };
    mine.onclose = () => {
      if (socket !== mine) return;
      hasRead = true;
      onFirst();
      emit("connection", false);
      timer = setTimeout(connect, waitMs, name);
      waitMs = Math.min(waitMs * 2, LONGEST_WAIT_MS);
    };
  }

  async function begin(/** @type {string} */ name) {
    /** @type {Promise<void>} */
    const first = new Promise((resolve) => {
      onFirst = resolve;
    });
    connect(name);
    await Promise.race([first, new Promise((resolve) => setTimeout(resolve, FIRST_CONNECTION_MS))]);
    if (project === name) hasRead = true;
  }

  function send(/** @type {object} */ message) {
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
     * Receives the messages of a project; null: receives no messages. What is read after this call has resolved
     * is followed by every later message, or by "reconnected".
     */
    follow(/** @type {string | null} */ name) {
      if (name === project) return ready;
      project = name;
      shownFrame = null;
      hasRead = false;
      onFirst();
      clearTimeout(timer);
      const old = socket;
      socket = null;
      old?.close();
      // without a project there is no connection that could be lost
      if (name === null) emit("connection", true);
      ready = name === null ? Promise.resolve() : begin(name);
      return ready;
    },

    /** Reports to the other pages which frame is open on this page; null: no frame is open. */
    openFrame(/** @type {number | null} */ frame) {
      shownFrame = frame;
      send(frame === null ? { type: "close" } : { type: "open", frame });
    },
  };
}
