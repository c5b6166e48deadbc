/**
 * The key table, and the listener that calls its handlers.
 *
 * A row defines what a key does, and in which modes; modes register handlers by the row's id. While a row has no
 * handler, the browser (or the focused 2D editor) gets the key. The listener runs in the capture phase, also in the 3D
 * view's iframe, so that keys work wherever the focus is. Keys typed into a text field belong to the field. A key that
 * does not belong to its field leaves it, so that what was typed is stored before the handler runs.
 *
 * A key's name has its modifiers in the order Ctrl+Alt+Shift (Cmd counts as Ctrl), then a letter in capitals, a digit,
 * another character as typed (`?`, `+`), or the name from KeyboardEvent.key. The space bar is "Space".
 */

import { leaveField } from "./dom.js";

/**
 * @typedef {object} KeyRow
 * @property {string} id
 * @property {string[]} keys
 * @property {string[]} [shown] what the table shows in place of `keys`.
 * @property {string} label
 * @property {string[] | null} modes null: all.
 * @property {string} group
 */

const EDITING = ["label", "review"];
const EVERYWHERE = null;

/** @type {KeyRow[]} */
export const KEYS = [
  { id: "undo", keys: ["Ctrl+Z"], label: "Undo", modes: EVERYWHERE, group: "Everywhere" },
  { id: "redo", keys: ["Ctrl+Shift+Z", "Ctrl+Y"], label: "Redo", modes: EVERYWHERE, group: "Everywhere" },
  { id: "help", keys: ["?"], label: "Show this table", modes: EVERYWHERE, group: "Everywhere" },
  {
    id: "regions",
    keys: ["F6"],
    label: "Move the focus to the top bar and back",
    modes: EVERYWHERE,
    group: "Everywhere",
  },
  { id: "next-frame", keys: ["N", "PageDown"], label: "Next frame", modes: EDITING, group: "Frames and boxes" },
  { id: "previous-frame", keys: ["P", "PageUp"], label: "Previous frame", modes: EDITING, group: "Frames and boxes" },
  { id: "next-box", keys: ["Tab"], label: "Next box", modes: EDITING, group: "Frames and boxes" },
  { id: "previous-box", keys: ["Shift+Tab"], label: "Previous box", modes: EDITING, group: "Frames and boxes" },
  {
    id: "class",
    keys: ["1", "2", "3", "4", "5", "6", "7", "8", "9"],
    shown: ["1", "…", "9"],
    label: "Class",
    modes: EDITING,
    group: "Frames and boxes",
  },
  {
    id: "attribute",
    keys: alt("0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"),
    shown: ["Alt", "its key"],
    label: "Next value of the attribute with this key, or the class with it (set the keys in the class editor)",
    modes: EDITING,
    group: "Frames and boxes",
  },
  {
    id: "delete",
    keys: ["Delete", "Backspace"],
    shown: ["Del"],
    label: "Delete",
    modes: EDITING,
    group: "Frames and boxes",
  },
  {
    id: "cancel",
    keys: ["Escape"],
    label: "Cancel the drag, then deselect",
    modes: EDITING,
    group: "Frames and boxes",
  },
  { id: "finalise", keys: ["Ctrl+Enter"], label: "Finalise the frame", modes: EDITING, group: "Frames and boxes" },
  {
    id: "accept-suggestion",
    keys: ["Enter"],
    label: "Accept the suggested (dashed) boxes, or the whole box, of the object",
    modes: ["label"],
    group: "Label",
  },
  {
    id: "box-kind",
    keys: ["B"],
    label: "Boxes enclose the visible part / the whole object",
    modes: ["label"],
    group: "Label",
  },
  {
    id: "next-whole-box",
    keys: ["W"],
    label: "Show another whole box (dashed) for a finished object",
    modes: ["label"],
    group: "Label",
  },
  {
    id: "accept",
    keys: ["Space"],
    label: "Accept, then go to the next: of the queue, or else of this frame",
    modes: ["review"],
    group: "Review",
  },
  {
    id: "accept-all",
    keys: ["Shift+Space"],
    shown: ["Shift", "Space"],
    label: "Accept all open boxes of the frame; in the queue, go to its next frame",
    modes: ["review"],
    group: "Review",
  },
  { id: "reject", keys: ["X"], label: "Reject", modes: ["review"], group: "Review" },
  { id: "refit", keys: ["G"], label: "Fit again from this box", modes: ["review"], group: "Review" },
  { id: "flip", keys: ["F"], label: "Turn the heading by 90°", modes: ["review"], group: "Review" },
  { id: "gizmo-translate", keys: ["T"], label: "Move with the gizmo", modes: ["review"], group: "Review" },
  { id: "gizmo-rotate", keys: ["R"], label: "Turn with the gizmo", modes: ["review"], group: "Review" },
  { id: "gizmo-off", keys: ["Y"], label: "Hide the gizmo", modes: ["review"], group: "Review" },
  {
    id: "draw-box",
    keys: ["B", "Insert"],
    shown: ["B"],
    label: "New box: drag on the image (also without this key)",
    modes: ["review"],
    group: "Review",
  },
  {
    id: "copy-previous",
    keys: ["C"],
    label: "Copy boxes from the previous frame",
    modes: ["review"],
    group: "Review",
  },
  {
    id: "follow",
    keys: ["V"],
    label: "Follow this reviewed or new box through the recording",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "follow-back",
    keys: ["Shift+V"],
    shown: ["Shift", "V"],
    label: "Follow it backward",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "follow-all",
    keys: ["L"],
    label: "Follow all reviewed boxes of this frame",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "follow-all-back",
    keys: ["Shift+L"],
    shown: ["Shift", "L"],
    label: "Follow them backward",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "sheet",
    keys: ["S"],
    label: "Contact sheet of this object's track",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "copy-next",
    keys: ["Shift+C"],
    shown: ["Shift", "C"],
    label: "Copy this box to the next frame",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "carry",
    keys: ["A"],
    label: "Correct the later proposals of the track like this box",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "interpolate",
    keys: ["I"],
    label: "Fill the frames back to the track's previous reviewed box",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "interpolate-refit",
    keys: ["Shift+I"],
    shown: ["Shift", "I"],
    label: "The same, with each box fitted to its points",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "next-of-track",
    keys: ["Shift+N"],
    shown: ["Shift", "N"],
    label: "Next frame of this object",
    modes: ["review"],
    group: "Tracks",
  },
  {
    id: "previous-of-track",
    keys: ["Shift+P"],
    shown: ["Shift", "P"],
    label: "Previous frame of this object",
    modes: ["review"],
    group: "Tracks",
  },
  { id: "points-larger", keys: ["+", "="], shown: ["+"], label: "Larger points", modes: EDITING, group: "View" },
  { id: "points-smaller", keys: ["-"], label: "Smaller points", modes: EDITING, group: "View" },
  { id: "fit", keys: ["0", "Home"], label: "Fit the pictures to their panels", modes: EDITING, group: "View" },
  {
    id: "nudge",
    keys: arrows(["", "Shift+"]),
    shown: ["← ↑ → ↓"],
    label: "Move the box by 1 px, with Shift by 10",
    modes: EDITING,
    group: "2D boxes",
  },
  {
    id: "nudge-size",
    keys: arrows(["Alt+", "Alt+Shift+"]),
    shown: ["Alt", "← ↑ → ↓"],
    label: "Move its right or lower edge",
    modes: EDITING,
    group: "2D boxes",
  },
  { id: "new-box", keys: ["Insert"], label: "New box in the middle", modes: ["label"], group: "2D boxes" },
  // the 2D editor handles these itself
  {
    id: "editor-zoom",
    keys: [],
    shown: ["Wheel"],
    label: "Zoom about the pointer",
    modes: EDITING,
    group: "2D boxes",
  },
  {
    id: "editor-pan",
    keys: [],
    shown: ["Space", "drag"],
    label: "Pan (or the middle button, or two fingers)",
    modes: ["label"],
    group: "2D boxes",
  },
  {
    id: "editor-force",
    keys: [],
    shown: ["Shift", "drag"],
    label: "Draw a new box over a selected one",
    modes: EDITING,
    group: "2D boxes",
  },
];

/** @param {string} keys */
function alt(keys) {
  return [...keys].map((key) => `Alt+${key}`);
}

/** @param {string[]} prefixes */
function arrows(prefixes) {
  return prefixes.flatMap((prefix) =>
    ["ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown"].map((name) => prefix + name),
  );
}

/**
 * The name of a keyboard event's key, as in the table.
 *
 * @param {KeyboardEvent} event
 */
function keyName(event) {
  let name = event.key === " " ? "Space" : event.key;
  // a Mac types other characters with Alt
  const plain = event.altKey && !/^[a-z0-9]$/i.test(name) && /^(?:Key|Digit)(.)$/.exec(event.code);
  if (plain) name = plain[1];
  const isLetter = /^\p{L}$/u.test(name);
  if (isLetter) name = name.toUpperCase();
  const shift = event.shiftKey && (isLetter || name.length > 1) ? "Shift+" : "";
  return `${event.ctrlKey || event.metaKey ? "Ctrl+" : ""}${event.altKey ? "Alt+" : ""}${shift}${name}`;
}

const TYPED = new Set(["text", "search", "email", "url", "password", "tel", "date", "time"]);

/**
 * True if a key belongs to the focused field.
 *
 * @param {KeyboardEvent} event
 * @param {string} name
 */
function isForField(event, name) {
  if (/^Alt\+[0-9A-Z]$/.test(name)) return false;
  // an element of this page or of the 3D view's, or a window
  const {
    tagName: tag,
    type = "",
    isContentEditable = false,
  } = /** @type {Partial<HTMLInputElement>} */ (event.composedPath()[0] ?? {});
  if (tag === "TEXTAREA" || isContentEditable || (tag === "INPUT" && TYPED.has(type))) return name !== "F6";
  // a number field needs digits and signs, but no letters
  if (tag === "INPUT" && (type === "number" || type === "range"))
    return !/^(Ctrl\+(Shift\+)?[ZY]|Space|[A-DF-Z]|F6)$/.test(name);
  if (tag === "SELECT") return name !== "F6" && !name.startsWith("Ctrl+");
  // on a focused control, Tab moves to the next one and Enter activates it
  if (tag === "BUTTON" || tag === "A" || tag === "INPUT" || tag === "SUMMARY")
    return /^(Shift\+)?Tab$/.test(name) || name === "Enter";
  return false;
}

export function createKeys() {
  /** @type {Map<string, KeyHandler[]>} */
  const handlers = new Map();
  /** @type {string | null} */
  let mode = null;

  /** @param {KeyboardEvent} event */
  function onKey(event) {
    if (event.defaultPrevented || document.querySelector("dialog[open]")) return;
    const name = keyName(event);
    const digit = /^Digit([1-9])$/.exec(event.code)?.[1];
    const row =
      findRow(name) ??
      (digit && !event.ctrlKey && !event.altKey && !event.metaKey && !event.shiftKey ? findRow(digit) : undefined);
    const handler = row && handlers.get(row.id)?.at(-1);
    if (!handler || isForField(event, name)) return;
    // with Alt, a letter may be typed after all
    if (row.id !== "attribute") leaveField();
    if (handler(event, digit && !row.keys.includes(name) ? digit : name) === false) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  /** @param {string} name */
  function findRow(name) {
    return KEYS.find(
      ({ id, keys, modes }) =>
        keys.includes(name) && (!modes || (mode && modes.includes(mode))) && handlers.get(id)?.length,
    );
  }

  return {
    table: KEYS,

    /**
     * Which mode's rows are active.
     *
     * @param {string | null} name
     */
    setMode(name) {
      mode = name;
    },

    /**
     * Registers handlers: {"next-frame": (event, key) => ...}. One that returns false leaves the key to the browser.
     * The newest handler of an id is used. Returns a function that removes these handlers.
     *
     * @param {Record<string, KeyHandler>} map
     */
    register(map) {
      const added = Object.entries(map);
      for (const [id, fn] of added) {
        if (!KEYS.some((row) => row.id === id)) throw new Error(`no row '${id}' in the key table`);
        handlers.set(id, [...(handlers.get(id) ?? []), fn]);
      }
      return () => {
        for (const [id, fn] of added) {
          const others = (handlers.get(id) ?? []).filter((other) => other !== fn);
          handlers.set(id, others);
        }
      };
    },

    /**
     * Listens to the keys of a window: the page's own, or the 3D view's.
     *
     * @param {Window} target
     */
    listen(target) {
      target.addEventListener("keydown", onKey, { capture: true });
    },
  };
}
