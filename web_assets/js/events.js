/** The server's live messages, over one WebSocket, which is reopened whenever the connection is lost. */

const FIRST_WAIT_MS = 400;
const LONGEST_WAIT_MS = 8000;
// A page does not wait longer for the first connection; it reads everything again once it is connected.
const FIRST_CONNECTION_MS = 2000;

/** Functions that are called by a name. */
export function createListeners() {
  /** @type {Map<string, Set<(value: never) => unknown>>} */
  const known = new Map();
  return {
    call(/** @type {string} */ name, /** @type {unknown} */ value) {
      for (const fn of [...(known.get(name) ?? [])]) fn(/** @type {never} */ (value));
    },
    /** Calls a function until it is removed, which the answer does, or until `until` is aborted. */
    on(/** @type {string} */ name, /** @type {(value: never) => unknown} */ fn, /** @type {AbortSignal=} */ until) {
      const all = known.get(name) ?? new Set();
      known.set(name, all.add(fn));
      const remove = () => all.delete(fn);
      until?.addEventListener("abort", remove);
      return remove;
    },
  };
}

/** See `Messages` for the types of messages and their contents. */
export function createEvents() {
  const listeners = createListeners();
  /** @type {WebSocket | null} */
  let socket = null;
  /** @type {string | null | undefined} */
  let project;
  /** @type {number | null} */
  let shownFrame = null;
  let waitMs = FIRST_WAIT_MS;
  let timer = 0;
  /** Whether the page may have read something before it was connected. */
  let hasRead = false;
  let onFirst = () => {};
  let ready = Promise.resolve();

  /** @type {<K extends keyof Messages>(type: K, message: Messages[K]) => void} */
  const emit = listeners.call;

  function connect(/** @type {string | null} */ name) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const of = name === null ? "" : `?project=${encodeURIComponent(name)}`;
    const mine = new WebSocket(`${scheme}://${location.host}/api/events${of}`);
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

  async function begin(/** @type {string | null} */ name) {
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
     * Calls a function for each message of a type; see `createListeners`.
     *
     * @type {<K extends keyof Messages>(type: K, fn: (message: Messages[K]) => unknown, until?: AbortSignal) => () => void}
     */
    on: listeners.on,

    /**
     * Receives the messages of a project, besides those about jobs; null: receives only these. What is read after this
     * call has resolved is followed by every later message, or by "reconnected".
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
      ready = begin(name);
      return ready;
    },

    /** Reports to the other pages which frame is open on this page; null: no frame is open. */
    openFrame(/** @type {number | null} */ frame) {
      shownFrame = frame;
      send(frame === null ? { type: "close" } : { type: "open", frame });
    },
  };
}
