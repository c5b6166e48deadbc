/**
 * Following reviewed boxes through the recording: the server does it frame by frame, and this panel shows how far it
 * is, what became of each object, and where the next reviewed box is needed.
 */

import { trackColor } from "../colors.js";
import { button, count, h, iconButton, patch } from "../dom.js";
import { currentFrame } from "../frame_state.js";
import { frameName } from "../timeline/reading.js";
import { isOpen } from "./desk.js";

/** Numbers of the runs that the operator has closed. */
const closed = new Set();

export function createFollow(/** @type {Annotate} */ at) {
  const { app, desk, opening } = at;
  const title = h("span.grow", { "data-testid": "follow-title" });
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const stop = button("Stop", () => void end(), { class: "danger", "data-testid": "follow-stop" });
  const close = iconButton("close", "Close", () => hide(), { "data-testid": "follow-close" });
  const list = h("ul.followed");
  const body = h(
    "div.follow",
    { hidden: true, role: "status", "data-testid": "follow" },
    h("div.row.pad", title, stop, close),
    bar,
    list,
  );
  at.parts.track.append(body);
  /** The latest run. @type {Api.FollowRunJson | null} */
  let run = null;
  /**
   * The frame where the operator has just begun to follow, and the number of the run once it is known.
   *
   * @type {{ frame: number, number: number | null } | null}
   */
  let begun = null;

  app.events.on("follow", (message) => take(message.run), at.until);
  app.events.on("reconnected", load, at.until);

  async function load() {
    const before = run;
    const answer = await app.api.get(app.path("follow"));
    if (answer) take(answer);
    else if (run === before) {
      // the server was restarted; it remembers no run
      run = null;
      show();
    }
  }

  function take(/** @type {Api.FollowRunJson} */ next) {
    if (next.operator !== app.state.operator || closed.has(next.number)) return;
    // the answer to a request may come after the first events of its run
    if (run && (next.number < run.number || (next.number === run.number && next.done < run.done))) return;
    run = next.state === "undone" ? null : next;
    show();
    visitFirst();
  }

  function visitFirst() {
    if (begun === null || run === null || begun.number !== run.number) return;
    if (run.first) {
      const [frame, uid] = run.first;
      const isStillThere = app.state.frame?.frame.id === begun.frame && !desk.hasDraft;
      begun = null;
      if (isStillThere) openFirst({ frame, uid });
    } else if (run.state !== "running") {
      begun = null;
      app.toast(run.message ?? "No box was found; the panel says why.", "warn");
    }
  }

  /** Opens the first new box of a run that was just begun, unless the operator is elsewhere, or draws here. */
  function openFirst(/** @type {Target} */ target) {
    if (opening.loading || at.image.isBusy || desk.shown?.isNew || at.sheet.again()) return;
    // what is open here comes first
    if (desk.labels().some(isOpen)) opening.pick(null);
    else void opening.go(target, true);
  }

  function show() {
    body.hidden = run === null;
    if (!run) return;
    const present = run;
    const isRunning = run.state === "running";
    body.dataset.state = run.state;
    const isFit = run.direction === "between";
    const how = `${isFit ? "filled boxes" : run.direction} ${run.has_detector ? "with the project's detector" : "by points"}`;
    const states = { stopped: "Stopped", failed: "Failed", undone: "" };
    const [running, done] = isFit ? ["Fitting", "Fitted"] : ["Following", "Followed"];
    title.textContent = `${{ ...states, running, done }[run.state]} ${how}`;
    title.title = title.textContent;
    stop.hidden = !isRunning;
    bar.style.visibility = isRunning ? "visible" : "hidden";
    close.hidden = isRunning;
    bar.value = run.total > 0 ? run.done / run.total : 1;
    patch(
      list,
      run.message ? h("li.bad", run.message) : null,
      run.tracks.map((track) => trackRow(present, track)),
    );
  }

  function trackRow(/** @type {Api.FollowRunJson} */ of, /** @type {Api.FollowedTrack} */ track) {
    const name = track.track_id === null ? track.label : `Track ${track.track_id} (${track.label})`;
    const left = track.doubtful > 0 ? `, ${count(track.doubtful, "doubtful frame")} left out` : "";
    const text = `${name}: ${count(track.boxes, "box", "boxes")}${left}${reached(of, track)}`;
    // the colours of tracks are too light for text
    const dot = h("span.dot");
    dot.style.background = trackColor(track.track_id);
    const stops = track.stops.map(({ frame_id: frame, key, reason }) =>
      button([h("b", `${frameName(app.state, frame, key)} →`), ` ${reason}`], () => opening.go({ frame, uid: null }), {
        class: "stop",
        title: `Go to this frame (${key}) and correct or draw the box; then follow it from there`,
        "data-testid": "follow-go",
        "data-frame": String(frame),
      }),
    );
    return h("li", { "data-testid": "followed" }, h("span.grow", dot, text), stops);
  }

  /** How far an object was followed; empty while it is not known, and if it has not come so far. */
  function reached(/** @type {Api.FollowRunJson} */ of, /** @type {Api.FollowedTrack} */ { stops, is_open }) {
    if (of.state !== "done" || of.direction === "between" || stops.length > 0) return "";
    if (!is_open) return ", to its next reviewed box";
    return `, to the recording's ${of.direction === "backward" ? "first" : "last"} frame`;
  }

  function hide() {
    if (run) closed.add(run.number);
    run = null;
    show();
  }

  async function end() {
    stop.disabled = true;
    try {
      await app.api.post(app.path("follow", "stop"));
    } finally {
      stop.disabled = false;
    }
  }

  /** Follows a reviewed box, or all reviewed boxes of the frame (null). */
  async function start(/** @type {"forward" | "backward"} */ direction, /** @type {string | null} */ uid) {
    if (!app.state.frame) return;
    await desk.flush();
    const { id } = currentFrame(app).frame;
    const own = { frame: id, number: /** @type {number | null} */ (null) };
    begun = own;
    try {
      const answer = await desk.change({ path: ["follow"], body: () => ({ uid, direction }), stateOf: () => null });
      own.number = answer.number;
      take(answer);
      // events of the run may have come before its number
      visitFirst();
    } catch (error) {
      begun = null;
      app.toast(error);
    }
  }

  void load();

  return {
    start,
    /** Whether more boxes of a track are being found. */
    isFollowed: (/** @type {number} */ track) =>
      run?.state === "running" && run.direction !== "between" && run.tracks.some(({ track_id }) => track_id === track),
  };
}
