/**
 * The one table of keys, and the one listener that serves it.
 *
 * A row says which keys do what, and in which modes; handlers are registered by id. A row without a handler at the moment is
 * not caught, so the browser (or the focused 2D editor) gets the key. The listener sits in the capture phase and is added to
 * the viewer's iframe as well, so keys work wherever the focus is. Typing in a text field is left alone.
 *
 * Key names: modifiers in the order Ctrl+Alt+Shift (Cmd counts as Ctrl), then a letter in capitals, a digit, another
 * character as it is typed (`?`, `+`), or the name that KeyboardEvent.key has. Space is "Space".
 */

const EDITING = ["label", "review"];
const EVERYWHERE = null;

export const KEYS = [
  { id: "undo", keys: ["Ctrl+Z"], label: "Undo", modes: EVERYWHERE, group: "Everywhere" },
  { id: "redo", keys: ["Ctrl+Shift+Z", "Ctrl+Y"], label: "Redo", modes: EVERYWHERE, group: "Everywhere" },
  { id: "help", keys: ["?"], label: "This table", modes: EVERYWHERE, group: "Everywhere" },
  { id: "regions", keys: ["F6"], label: "Focus to the top bar and back", modes: EVERYWHERE, group: "Everywhere" },
  { id: "next-frame", keys: ["N", "PageDown"], label: "Next frame", modes: EDITING, group: "Frames and boxes" },
  { id: "previous-frame", keys: ["P", "PageUp"], label: "Previous frame", modes: EDITING, group: "Frames and boxes" },
  { id: "next-box", keys: ["Tab"], label: "Next box", modes: EDITING, group: "Frames and boxes" },
  { id: "previous-box", keys: ["Shift+Tab"], label: "Previous box", modes: EDITING, group: "Frames and boxes" },
  { id: "class", keys: ["1", "2", "3", "4", "5", "6", "7", "8", "9"], shown: ["1", "…", "9"], label: "Class", modes: EDITING, group: "Frames and boxes" },
  { id: "delete", keys: ["Delete", "Backspace"], shown: ["Del"], label: "Delete", modes: EDITING, group: "Frames and boxes" },
  { id: "cancel", keys: ["Escape"], label: "Cancel the drag, then deselect", modes: EDITING, group: "Frames and boxes" },
  { id: "finalise", keys: ["Ctrl+Enter"], label: "Finalise the frame", modes: EDITING, group: "Frames and boxes" },
  { id: "accept-suggestion", keys: ["Enter"], label: "Accept the suggested (dashed) box", modes: ["label"], group: "Label" },
  { id: "box-kind", keys: ["B"], label: "Boxes say: what I see / the whole box", modes: ["label"], group: "Label" },
  { id: "accept", keys: ["Space"], label: "Accept and go to the next", modes: ["review"], group: "Review" },
  { id: "reject", keys: ["X"], label: "Reject", modes: ["review"], group: "Review" },
  { id: "refit", keys: ["G"], label: "Fit again, starting from this box", modes: ["review"], group: "Review" },
  { id: "flip", keys: ["F"], label: "Turn the heading by 90°", modes: ["review"], group: "Review" },
  { id: "gizmo-translate", keys: ["T"], label: "Move with the gizmo", modes: ["review"], group: "Review" },
  { id: "gizmo-rotate", keys: ["R"], label: "Turn with the gizmo", modes: ["review"], group: "Review" },
  { id: "gizmo-off", keys: ["Y"], label: "No gizmo: sizes in the views", modes: ["review"], group: "Review" },
  { id: "draw-box", keys: ["B", "Insert"], shown: ["B"], label: "New box: drag one on the image", modes: ["review"], group: "Review" },
  { id: "copy-previous", keys: ["C"], label: "Copy boxes from the previous frame", modes: ["review"], group: "Review" },
  { id: "propose-next", keys: ["V"], label: "Propose the next frame from this one's reviewed boxes", modes: ["review"], group: "Tracks" },
  { id: "copy-next", keys: ["Shift+C"], shown: ["Shift", "C"], label: "Copy this box to the next frame", modes: ["review"], group: "Tracks" },
  { id: "interpolate", keys: ["I"], label: "Fill the frames back to the track's reviewed box before", modes: ["review"], group: "Tracks" },
  { id: "interpolate-refit", keys: ["Shift+I"], shown: ["Shift", "I"], label: "The same, each box fitted to its points", modes: ["review"], group: "Tracks" },
  { id: "next-of-track", keys: ["Shift+N"], shown: ["Shift", "N"], label: "The same object in its next frame", modes: ["review"], group: "Tracks" },
  { id: "previous-of-track", keys: ["Shift+P"], shown: ["Shift", "P"], label: "The same object in its previous frame", modes: ["review"], group: "Tracks" },
  { id: "points-larger", keys: ["+", "="], shown: ["+"], label: "Larger points", modes: EDITING, group: "View" },
  { id: "points-smaller", keys: ["-"], label: "Smaller points", modes: EDITING, group: "View" },
  { id: "fit", keys: ["0", "Home"], label: "Fit the pictures", modes: EDITING, group: "View" },
  { id: "nudge", keys: arrows(["", "Shift+"]), shown: ["← ↑ → ↓"], label: "Move the box by 1 px, with Shift by 10", modes: EDITING, group: "2D boxes" },
  { id: "nudge-size", keys: arrows(["Alt+", "Alt+Shift+"]), shown: ["Alt", "← ↑ → ↓"], label: "Move its right or lower edge", modes: EDITING, group: "2D boxes" },
  { id: "new-box", keys: ["Insert"], label: "New box in the middle", modes: ["label"], group: "2D boxes" },
  // Served by the 2D editor itself, here for the table.
  { id: "editor-zoom", keys: [], shown: ["Wheel"], label: "Zoom about the pointer", modes: EDITING, group: "2D boxes" },
  { id: "editor-pan", keys: [], shown: ["Space", "drag"], label: "Pan (or the middle button, or two fingers)", modes: ["label"], group: "2D boxes" },
  { id: "editor-force", keys: [], shown: ["Shift", "drag"], label: "Draw a new box over a selected one", modes: EDITING, group: "2D boxes" },
];

function arrows(prefixes) {
  return prefixes.flatMap((prefix) => ["ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown"].map((name) => prefix + name));
}

/** The name of a keyboard event's key, as the table has it. */
export function keyName(event) {
  let name = event.key === " " ? "Space" : event.key;
  const is_letter = /^\p{L}$/u.test(name);
  if (is_letter) name = name.toUpperCase();
  const shift = event.shiftKey && (is_letter || name.length > 1) ? "Shift+" : "";
  return `${event.ctrlKey || event.metaKey ? "Ctrl+" : ""}${event.altKey ? "Alt+" : ""}${shift}${name}`;
}

const TYPED = new Set(["text", "search", "email", "url", "password", "tel", "date", "time"]);

/** True where a key belongs to the field that has the focus. */
function isForField(event, name) {
  const target = event.composedPath()[0];
  const tag = target?.tagName;
  if (tag === "TEXTAREA" || target?.isContentEditable || (tag === "INPUT" && TYPED.has(target.type))) return name !== "F6";
  // A number field types digits and signs; letters are no use to it.
  if (tag === "INPUT" && (target.type === "number" || target.type === "range")) return !/^(Ctrl\+(Shift\+)?[ZY]|Space|[A-DF-Z]|F6)$/.test(name);
  if (tag === "SELECT") return name !== "F6" && !name.startsWith("Ctrl+");
  // Tab walks through controls once the focus is on one that the keyboard has reached, Enter presses it.
  if (tag === "BUTTON" || tag === "A" || tag === "INPUT" || tag === "SUMMARY") return /^(Shift\+)?Tab$/.test(name) || name === "Enter";
  return false;
}

export function createKeys() {
  const handlers = new Map();
  let mode = null;

  function onKey(event) {
    if (event.defaultPrevented || document.querySelector("dialog[open]")) return;
    const name = keyName(event);
    const digit = /^Digit([1-9])$/.exec(event.code)?.[1];
    const row = findRow(name) ?? (digit && !event.ctrlKey && !event.altKey && !event.metaKey && !event.shiftKey ? findRow(digit) : undefined);
    if (!row || isForField(event, name)) return;
    const stack = handlers.get(row.id);
    if (stack[stack.length - 1](event, row.keys.includes(name) ? name : digit) === false) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  function findRow(name) {
    return KEYS.find((row) => row.keys.includes(name) && (!row.modes || row.modes.includes(mode)) && handlers.get(row.id)?.length);
  }

  return {
    table: KEYS,

    /** Which mode's rows count; the router sets it. */
    setMode(name) {
      mode = name;
    },
    get mode() {
      return mode;
    },

    /**
     * Registers handlers: {"next-frame": (event, key) => ...}; one that returns false leaves the key to the browser.
     * The newest handler of an id wins. Returns the function that takes them off again.
     */
    register(map) {
      const added = Object.entries(map);
      for (const [id, fn] of added) {
        if (!KEYS.some((row) => row.id === id)) throw new Error(`no row '${id}' in the key table`);
        handlers.set(id, [...(handlers.get(id) ?? []), fn]);
      }
      return () => {
        for (const [id, fn] of added) handlers.set(id, handlers.get(id).filter((other) => other !== fn));
      };
    },

    /** Serves a window or document (the page's own, or the viewer's) in the capture phase. */
    listen(target) {
      target.addEventListener("keydown", onKey, { capture: true });
    },

    /** True where the table serves this key at the moment (the viewer keeps all others from its camera). */
    serves: (event) => Boolean(findRow(keyName(event))),
  };
}
