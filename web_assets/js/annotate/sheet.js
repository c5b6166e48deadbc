/**
 * The contact sheet of a track: a small picture of each box along its own axes. The wrong ones are clicked out, with
 * Shift from one to the end, and Enter accepts the others, in all frames at once. The wrong ones stay proposals.
 * Ctrl+click does all of it for an object that was lost: it accepts what is before this box, and opens this one. Once
 * the operator has corrected it, and follows it or corrects the later ones alike, the sheet comes back by itself, and
 * new boxes appear on it as they are found.
 */

import { openDialog } from "../dialogs.js";
import { button, count, h, patch } from "../dom.js";
import { currentFrame } from "../frame_state.js";
import { frameName } from "../timeline/reading.js";

const HELP =
  "Top, front and right side of each box; the front is orange. Click on the wrong ones; they stay proposals. " +
  "Ctrl+click on the first wrong one accepts those before it, and opens it.";

/** The size of a picture, px. */
const WIDTH = 292;
const HEIGHT = 96;

export function createSheet(/** @type {Annotate} */ at) {
  const { app, desk, queue, opening, preload } = at;
  /** Tracks whose sheet was left to correct a box, as "recording/track". @type {Set<string>} */
  const left = new Set();

  const nameOf = (/** @type {number} */ track) => `${currentFrame(app).frame.recording}/${track}`;

  /**
   * Shows the track of the selected box, and stores what is accepted.
   *
   * @param {boolean} isOwn the operator asked for it.
   */
  async function show(isOwn) {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null || label.track_id === undefined)
      return app.toast("This box has no track yet. Type a number in its field Track.", "warn");
    // on a new server these share the processor with the pictures, which are awaited
    const held = [preload.hold(), app.viewport.hold()];
    try {
      await desk.flush();
      const { recording } = currentFrame(app).frame;
      const shown = await read(recording, label.track_id);
      if (!shown.some(isOpen)) return app.toast("All boxes of this track are reviewed.");
      if (isOwn) app.effort.action();
      await ask(recording, label.track_id, shown, !isOwn);
    } finally {
      for (const release of held) release();
    }
  }

  /** Shows the sheet again if it was left to correct a box of the selected one's track. Returns whether it was. */
  function again() {
    const track = desk.stored()?.track_id ?? null;
    if (track === null || !left.delete(nameOf(track))) return false;
    void show(false);
    return true;
  }

  /** The boxes of a track that can be shown. */
  async function read(/** @type {number} */ recording, /** @type {number} */ track) {
    const boxes = await app.api.get(app.path("recordings", recording, "tracks", track));
    return boxes.filter(({ index, state }) => index !== null && state !== "rejected");
  }

  /**
   * @param {number} recording
   * @param {number} track
   * @param {Api.TrackBox[]} shown
   * @param {boolean} isBack boxes have just been found, or corrected.
   */
  async function ask(recording, track, shown, isBack) {
    /** @type {Set<string>} */
    const out = new Set();
    /** All boxes from this one on are wrong, also those that are found later. @type {string | null} */
    let outFrom = null;
    /** The box to open when the sheet is closed. @type {string | null} */
    let corrected = null;
    let proposals = shown.filter(isOpen);
    /** @type {Map<string, HTMLElement>} */
    const tiles = new Map();
    const grid = h("div.sheet", { onkeydown: onKey });
    const note = h("p.muted", { role: "status", "data-testid": "sheet-note" });

    function tile(/** @type {Api.TrackBox} */ box) {
      const name = frameName(app.state, box.frame, box.key);
      return button(
        [h("img", { alt: "", width: WIDTH, height: HEIGHT, decoding: "async" }), h("span.ellipsis", name)],
        (event) => (event.ctrlKey || event.metaKey ? correct(box) : toggle(box.uid, event.shiftKey)),
        {
          class: `tile state-${box.state}`,
          disabled: !isOpen(box),
          "aria-pressed": isOpen(box) ? "false" : null,
          "aria-label": `Frame ${name}, ${box.state}`,
          title: isOpen(box)
            ? "Click: it is wrong. Shift+click: all from here are. Ctrl+click: accept those before it, and open it"
            : `${box.state} already`,
          "data-testid": "sheet-box",
          "data-uid": box.uid,
          // a tile of another state is another one: `tiles` has it
          "data-key": `${box.uid} ${box.state}`,
        },
      );
    }

    /** Shows these boxes, which may be others than before. */
    function fill(/** @type {Api.TrackBox[]} */ boxes) {
      shown = boxes;
      proposals = shown.filter(isOpen);
      const states = new Map(shown.map(({ uid, state }) => [uid, state]));
      for (const [uid, known] of [...tiles]) {
        if (known.classList.contains(`state-${states.get(uid)}`)) continue;
        tiles.delete(uid);
        out.delete(uid);
      }
      const firstOut = shown.findIndex(({ uid }) => uid === outFrom);
      for (const [at, box] of shown.entries()) {
        if (tiles.has(box.uid)) continue;
        tiles.set(box.uid, tile(box));
        if (firstOut >= 0 && at > firstOut && isOpen(box)) mark(box.uid, false, true);
      }
      patch(
        grid,
        shown.map(({ uid }) => tiles.get(uid)),
      );
      note.textContent = `${count(proposals.length, "proposal")} of ${count(shown.length, "box", "boxes")}. ${
        at.follow.isFollowed(track) ? "The object is still being followed; new boxes appear here." : HELP
      }`;
    }

    function toggle(/** @type {string} */ uid, /** @type {boolean} */ isAll) {
      app.effort.action();
      const isOut = !out.has(uid);
      corrected = null;
      if (isAll) outFrom = isOut ? uid : null;
      mark(uid, isAll, isOut);
    }

    function mark(/** @type {string} */ from, /** @type {boolean} */ isAll, /** @type {boolean} */ isOut) {
      const at = proposals.findIndex(({ uid }) => uid === from);
      if (at < 0) return; // it was reviewed meanwhile
      for (const { uid } of proposals.slice(at, isAll ? undefined : at + 1)) {
        if (isOut) out.add(uid);
        else out.delete(uid);
        tiles.get(uid)?.setAttribute("aria-pressed", String(isOut));
      }
    }

    /** Accepts what is before a box, and opens this one. */
    function correct(/** @type {Api.TrackBox} */ { uid }) {
      mark(uid, true, true);
      corrected = uid;
      grid.closest("form")?.requestSubmit();
    }

    /** Enter accepts also while a picture has the focus; the space bar clicks it out. */
    function onKey(/** @type {KeyboardEvent} */ event) {
      if (event.key !== "Enter") return;
      event.preventDefault();
      if (event.target instanceof HTMLElement) event.target.closest("form")?.requestSubmit();
    }

    /** Accepts the others; resolves to the box to correct, else to the first wrong one. */
    async function accept() {
      // what is found after a box to correct is replaced when that one is followed
      if (corrected === null && at.follow.isFollowed(track))
        throw new Error("The object is still being followed. Wait for the last boxes, or close this.");
      const right = proposals.filter(({ uid }) => !out.has(uid));
      app.effort.action();
      if (right.length > 0) {
        const seen = right.map(({ frame, revision, uid }) => ({ frame, revision, uid }));
        await desk.enqueue(() => app.api.change(app.path("sheet", "accept"), { boxes: seen }));
        await app.frames.refresh();
        await queue.load();
        app.toast(`${count(right.length, "box", "boxes")} accepted.`, "good");
      }
      const wrong = proposals.filter(({ uid }) => out.has(uid));
      return wrong.find(({ uid }) => uid === corrected) ?? wrong[0] ?? null;
    }

    function picture(/** @type {Api.TileJson} */ { uid, png, problem }) {
      const image = tiles.get(uid)?.querySelector("img");
      if (!image) return;
      if (png) image.src = `data:image/png;base64,${png}`;
      else image.alt = problem ?? "";
    }

    const closed = new AbortController();
    const { signal } = closed;
    let isReading = false;
    let mustRead = false;

    /** Reads the pictures, and what has been found in the meantime. One request at a time. */
    async function load() {
      mustRead = isReading;
      if (isReading) return;
      isReading = true;
      try {
        await app.api.lines(app.path("recordings", recording, "tracks", track, "sheet"), picture, { signal });
      } finally {
        isReading = false;
      }
      if (mustRead && !signal.aborted) await load();
    }

    let asked = 0;

    /** Shows what has been found since. */
    async function update() {
      asked += 1;
      const own = asked;
      const boxes = await read(recording, track);
      if (signal.aborted || own !== asked) return;
      fill(boxes);
      await load();
    }

    left.delete(nameOf(track));
    fill(shown);
    void load();
    const stop = app.events.on("follow", ({ run }) => {
      const isOwn = run.operator === app.state.operator && run.tracks.some(({ track_id }) => track_id === track);
      if (isOwn) void update();
    });
    // more may have changed since `shown` was read
    if (isBack || at.follow.isFollowed(track)) void update();
    const done = await openDialog({
      title: `Track ${track}`,
      testid: "sheet",
      wide: true,
      content: [note, grid],
      actions: [{ label: "Accept the others", value: "accept" }],
      submit: async () => ({ wrong: await accept() }),
    });
    stop();
    closed.abort();
    if (done?.wrong) left.add(nameOf(track));
    const target = done && (done.wrong ?? (opening.inQueue ? queue.items[0] : null));
    if (target) await opening.go({ frame: target.frame, uid: target.uid }, true);
  }

  return { show: () => show(true), again };
}

const isOpen = (/** @type {Api.TrackBox} */ { state }) => state === "proposed";
