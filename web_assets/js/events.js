/** The server's live messages over one WebSocket that is opened again whenever it breaks. */

const FIRST_WAIT_MS = 400;
const LONGEST_WAIT_MS = 8000;

/**
 * Types of messages: frame, presence, job, viewport (as the server sends them), and of our own: `connection` (true or
 * false) and `reconnected` (messages may have been missed: read again what is shown).
 */
export function createEvents() {
  const listeners = new Map();
  let socket = null;
  let project = null;
  let open_frame = null;
  let wait_ms = FIRST_WAIT_MS;
  let timer = 0;
  let was_connected = false;

  function emit(type, message) {
    for (const fn of [...(listeners.get(type) ?? [])]) fn(message);
  }

  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const mine = new WebSocket(`${scheme}://${location.host}/api/events?project=${encodeURIComponent(project)}`);
    socket = mine;
    mine.onopen = () => {
      wait_ms = FIRST_WAIT_MS;
      emit("connection", true);
      if (open_frame !== null) tell({ type: "open", project, frame: open_frame });
      if (was_connected) emit("reconnected", null);
      was_connected = true;
    };
    mine.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      emit(message.type, message);
    };
    mine.onclose = () => {
      if (socket !== mine) return;
      emit("connection", false);
      timer = setTimeout(connect, wait_ms);
      wait_ms = Math.min(wait_ms * 2, LONGEST_WAIT_MS);
    };
  }

  function tell(message) {
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  }

  return {
    /** Calls `fn(message)` for each message of a type. Returns the function that ends this. */
    on(type, fn) {
      if (!listeners.has(type)) listeners.set(type, new Set());
      listeners.get(type).add(fn);
      return () => listeners.get(type).delete(fn);
    },

    /** Listens to a project (null: to none). */
    follow(name) {
      if (name === project) return;
      project = name;
      open_frame = null;
      was_connected = false;
      clearTimeout(timer);
      const old = socket;
      socket = null;
      old?.close();
      if (project !== null) connect();
    },

    /** Tells the others which frame is open here; null: none. */
    openFrame(frame) {
      open_frame = frame;
      tell(frame === null ? { type: "close" } : { type: "open", project, frame });
    },
  };
}
