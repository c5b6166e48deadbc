/**
 * The contact sheet of a track: a small picture of each box along its own axes. The wrong ones are clicked out, with
 * Shift from one to the end, and Enter accepts the others, in all frames at once. The wrong ones stay proposals.
 */

import { openDialog } from "../dialogs.js";
import { count, h } from "../dom.js";
import { isAborted } from "../errors.js";
import { currentFrame } from "../frame_state.js";

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
  /** Shows the track of the selected box, and stores what is accepted. */
  return async function show() {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null || label.track_id === undefined)
      return app.toast("This box has no track. Enter a track id, or run `annotator track`.", "warn");
    await desk.flush();
    try {
      const { recording } = currentFrame(app).frame;
      /** @type {Api.TrackOut} */
      const { boxes } = await app.api.get(app.path("recordings", recording, "tracks", label.track_id));
      const shown = boxes.filter(({ index, state }) => index !== null && state !== "rejected");
      if (!shown.some(isOpen)) return app.toast("All boxes of this track are reviewed.");
      await ask(recording, label.track_id, shown);
    } catch (error) {
      app.toast(error);
    }
  };

  /**
   * @param {number} recording
   * @param {number} track
   * @param {Api.TrackBox[]} shown
   */
  async function ask(recording, track, shown) {
    /** @type {Set<string>} */
    const out = new Set();
    const proposals = shown.filter(isOpen);
    const tiles = new Map(shown.map((box) => [box.uid, tile(box)]));

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
          title: isOpen(box) ? "Click if it is wrong; Shift+click: this and all after it" : `${box.state} already`,
          "data-testid": "sheet-box",
          "data-uid": box.uid,
          onclick: (event) => toggle(box, event.shiftKey),
        },
        h("img", { alt: "", width: WIDTH, height: HEIGHT, decoding: "async" }),
        h("span", { class: "ellipsis" }, box.key),
      );
    }

    /**
     * @param {Api.TrackBox} box
     * @param {boolean} isAll
     */
    function toggle(box, isAll) {
      app.effort.action();
      const isOut = !out.has(box.uid);
      const from = proposals.indexOf(box);
      for (const { uid } of isAll ? proposals.slice(from) : [box]) {
        if (isOut) out.add(uid);
        else out.delete(uid);
        tiles.get(uid)?.setAttribute("aria-pressed", String(isOut));
      }
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
    function show({ uid, png, problem }) {
      const image = tiles.get(uid)?.querySelector("img");
      if (!image) return;
      if (png) image.src = `data:image/png;base64,${png}`;
      else image.alt = problem ?? "";
    }

    app.effort.action();
    const closed = new AbortController();
    const { signal } = closed;
    const pictures = app.api.lines(app.path("recordings", recording, "tracks", track, "sheet"), show, { signal });
    pictures.catch((error) => isAborted(error) || app.toast(error));
    const done = await openDialog({
      title: `Track ${track}: ${count(proposals.length, "proposal")} of ${count(shown.length, "box", "boxes")}`,
      testid: "sheet",
      wide: true,
      content: [
        h("p", { class: "muted" }, "Top, front and side of each box. Click on the wrong ones; they stay proposals."),
        h("div", { class: "sheet", onkeydown: onKey }, [...tiles.values()]),
      ],
      actions: [{ label: "Accept the others", value: "accept" }],
      submit: async () => ({ wrong: await accept() }),
    });
    closed.abort();
    const next = done && (done.wrong ?? queue.items[0]);
    if (next) await open({ frame: next.frame, uid: next.uid });
  }
}

/** @param {Api.TrackBox} box */
const isOpen = ({ state }) => state === "proposed";
