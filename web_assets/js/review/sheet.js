/**
 * The contact sheet of a track: a small picture of each box along its own axes. The wrong ones are clicked out, with
 * Shift from one to the end, and Enter accepts the others, in all frames at once. The wrong ones stay proposals.
 * Ctrl+click does all of it for an object that was lost: it accepts what is before this box, and opens this one. Once
 * the operator has corrected it, and follows it or corrects the later ones alike, the sheet comes back by itself, and
 * new boxes appear on it as they are found.
 */

import { openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { isAborted } from "../errors.js";
import { currentFrame } from "../frame_state.js";

const HELP =
  "Top, front and side of each box. Click on the wrong ones; they stay proposals. Ctrl+click on the first wrong one " +
  "accepts those before it, and opens it.";

/** The size of a picture, px. */
const WIDTH = 292;
const HEIGHT = 96;

/**
 * `open` shows a box in its frame.
 *
 * @param {ModeApp} app
 * @param {{ desk: Desk, queue: Queue, open: (target: Target) => unknown }} parts
 */
export function createSheet(app, { desk, queue, open }) {
  /**
   * Tracks whose sheet was left to correct a box, as "recording/track".
   *
   * @type {Set<string>}
   */
  const left = new Set();

  /** @param {number} track */
  const nameOf = (track) => `${currentFrame(app).frame.recording}/${track}`;

  /**
   * Shows the track of the selected box, and stores what is accepted.
   *
   * @param {boolean} isOwn the operator asked for it.
   * @param {boolean} isFollowing more boxes of the track are being found.
   */
  async function show(isOwn, isFollowing) {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null || label.track_id === undefined)
      return app.toast("This box has no track. Enter a track id, or run `annotator track`.", "warn");
    await desk.flush();
    try {
      const { recording } = currentFrame(app).frame;
      const shown = await read(recording, label.track_id);
      if (!shown.some(isOpen)) return app.toast("All boxes of this track are reviewed.");
      if (isOwn) app.effort.action();
      await ask(recording, label.track_id, shown, isFollowing);
    } catch (error) {
      app.toast(error);
    }
  }

  /**
   * Shows the sheet again if it was left to correct a box of the selected one's track. Returns whether it was.
   *
   * @param {boolean} isFollowing more boxes of the track are being found.
   */
  function again(isFollowing) {
    const track = desk.stored()?.track_id ?? null;
    if (track === null || !left.delete(nameOf(track))) return false;
    void show(false, isFollowing);
    return true;
  }

  /**
   * The boxes of a track that can be shown.
   *
   * @param {number} recording
   * @param {number} track
   */
  async function read(recording, track) {
    /** @type {Api.TrackOut} */
    const { boxes } = await app.api.get(app.path("recordings", recording, "tracks", track));
    return boxes.filter(({ index, state }) => index !== null && state !== "rejected");
  }

  /**
   * @param {number} recording
   * @param {number} track
   * @param {Api.TrackBox[]} shown
   * @param {boolean} isFollowing
   */
  async function ask(recording, track, shown, isFollowing) {
    /** @type {Set<string>} */
    const out = new Set();
    let proposals = shown.filter(isOpen);
    /** @type {Map<string, HTMLElement>} */
    const tiles = new Map();
    const grid = h("div", { class: "sheet", onkeydown: onKey });
    const note = h("p", { class: "muted", role: "status", "data-testid": "sheet-note" });

    /** @param {Api.TrackBox} box */
    function tile(box) {
      return h(
        "button",
        {
          type: "button",
          class: `tile state-${box.state}`,
          disabled: !isOpen(box),
          "aria-pressed": isOpen(box) ? "false" : null,
          "aria-label": `Frame ${box.key}, ${box.state}`,
          title: isOpen(box)
            ? "Click: it is wrong. Shift+click: all from here are. Ctrl+click: accept those before it, and open it"
            : `${box.state} already`,
          "data-testid": "sheet-box",
          "data-uid": box.uid,
          onclick: (event) => (event.ctrlKey || event.metaKey ? correct(box) : toggle(box.uid, event.shiftKey)),
        },
        h("img", { alt: "", width: WIDTH, height: HEIGHT, decoding: "async" }),
        h("span", { class: "ellipsis" }, box.key),
      );
    }

    /**
     * Shows these boxes, which may be others than before.
     *
     * @param {Api.TrackBox[]} boxes
     */
    function fill(boxes) {
      shown = boxes;
      proposals = shown.filter(isOpen);
      const kept = new Set(shown.map(({ uid }) => uid));
      for (const uid of [...tiles.keys()].filter((known) => !kept.has(known))) {
        tiles.delete(uid);
        out.delete(uid);
      }
      for (const box of shown) if (!tiles.has(box.uid)) tiles.set(box.uid, tile(box));
      grid.replaceChildren(...shown.flatMap(({ uid }) => tiles.get(uid) ?? []));
      note.textContent = `${count(proposals.length, "proposal")} of ${count(shown.length, "box", "boxes")}. ${
        isFollowing ? "The object is still being followed; new boxes appear here." : HELP
      }`;
    }

    /**
     * @param {string} uid
     * @param {boolean} isAll
     */
    function toggle(uid, isAll) {
      app.effort.action();
      mark(uid, isAll, !out.has(uid));
    }

    /**
     * @param {string} from
     * @param {boolean} isAll
     * @param {boolean} isOut
     */
    function mark(from, isAll, isOut) {
      const at = proposals.findIndex(({ uid }) => uid === from);
      for (const { uid } of proposals.slice(at, isAll ? undefined : at + 1)) {
        if (isOut) out.add(uid);
        else out.delete(uid);
        tiles.get(uid)?.setAttribute("aria-pressed", String(isOut));
      }
    }

    /**
     * Accepts what is before a box, and opens this one.
     *
     * @param {Api.TrackBox} box
     */
    function correct({ uid }) {
      mark(uid, true, true);
      isFollowing = false; // what is found later is replaced when this one is followed
      grid.closest("form")?.requestSubmit();
    }

    /**
     * Enter accepts also while a picture has the focus; the space bar clicks it out.
     *
     * @param {KeyboardEvent} event
     */
    function onKey(event) {
      if (event.key !== "Enter") return;
      event.preventDefault();
      if (event.target instanceof HTMLElement) event.target.closest("form")?.requestSubmit();
    }

    /** Accepts the others; resolves to the first wrong box. */
    async function accept() {
      if (isFollowing) throw new Error("The object is still being followed. Wait for the last boxes, or close this.");
      const right = proposals.filter(({ uid }) => !out.has(uid));
      app.effort.action();
      if (right.length > 0) {
        const seen = right.map(({ frame, revision, uid }) => ({ frame, revision, uid }));
        await desk.enqueue(() => app.api.change(app.path("sheet", "accept"), { boxes: seen }));
        await app.frames.refresh();
        await queue.load();
        app.toast(`${count(right.length, "box", "boxes")} accepted.`, "good");
      }
      return proposals.find(({ uid }) => out.has(uid)) ?? null;
    }

    /** @param {Api.TileJson} drawn */
    function picture({ uid, png, problem }) {
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
      } catch (error) {
        if (!isAborted(error)) app.toast(error);
      } finally {
        isReading = false;
      }
      if (mustRead && !signal.aborted) await load();
    }

    /** @param {{ run: Api.FollowRunJson }} message */
    async function onFollowed({ run }) {
      if (run.operator !== app.state.operator || !run.tracks.some(({ track_id }) => track_id === track)) return;
      try {
        const boxes = await read(recording, track);
        if (signal.aborted) return;
        isFollowing = run.state === "running";
        fill(boxes);
        await load();
      } catch (error) {
        app.toast(error);
      }
    }

    left.delete(nameOf(track));
    fill(shown);
    void load();
    const stop = app.events.on("follow", onFollowed);
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
    const next = done && (done.wrong ?? queue.items[0]);
    if (next) await open({ frame: next.frame, uid: next.uid });
  }

  return { show: () => show(true, false), again };
}

/** @param {Api.TrackBox} box */
const isOpen = ({ state }) => state === "proposed";
