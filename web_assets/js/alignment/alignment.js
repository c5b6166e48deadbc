/**
 * Alignment: how the cloud of a recording lies on its image, and which way is up. What is set here holds for all
 * frames of the recording, and can be undone.
 */

import { confirm } from "../dialogs.js";
import { count, h } from "../dom.js";
import { isAborted, messageOf } from "../errors.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { dot, multiply, transpose } from "../rotation.js";
import { anglesOf, upOf } from "./level.js";
import { createPicture, moved, rotationOf } from "./picture.js";
import { createSlider } from "./sliders.js";

/** @type {["x" | "y" | "z", string][]} */
const AXES = [
  ["x", "right"],
  ["y", "down"],
  ["z", "ahead"],
];
const SAME = 1e-9;

/**
 * @param {HTMLElement} root
 * @param {ModeApp} app
 */
export function mount(root, app) {
  /** @type {Api.AlignmentJson | null} */
  let known = null;
  /** @type {Vector[]} */
  let points = [];
  /**
   * The up direction that is shown, relative to the stored correction; null: unknown.
   *
   * @type {Vector | null}
   */
  let up = null;
  /** @type {Api.EstimatedUp | null} */
  let estimate = null;
  let frame = app.state.route.frame;
  let ended = false;
  let isBusy = false;
  /** Someone else has adjusted the recording since it was shown. */
  let isOutdated = false;
  /** The frame cannot be read. */
  let isBroken = false;

  const host = h("div", { class: "picture" });
  const problem = h("p", { class: "error-box", role: "alert", hidden: true, "data-testid": "alignment-problem" });
  const turns = AXES.map(([axis, where]) => slider(`Turn about ${axis} (${where})`, `turn-${axis}`, 5, 0.01, "°"));
  const shifts = AXES.map(([axis, where]) =>
    slider(`Shift along ${axis} (${where})`, `shift-${axis}`, 0.5, 0.001, "m"),
  );
  const offset = slider("Clouds' clock ahead", "time-offset", 1, 0.01, "s");
  const noTimes = h("p", { class: "help" }, "The frames have no times, so there is no time offset to correct.");
  const offsetNote = h("p", { class: "bad", hidden: true, "data-testid": "offset-note" });
  const keep = button("Keep this correction", "keep-correction", () =>
    save("correction", { correction: correction() }),
  );
  const back = button("Discard changes", "discard-correction", discard);
  const zero = button("Remove the correction", "clear-correction", () =>
    save("correction", { correction: { turn_deg: [0, 0, 0], shift_m: [0, 0, 0], time_offset_s: 0 } }),
  );
  const effect = h("p", { class: "help", "data-testid": "correction-effect" });
  const roll = levelSlider("Roll", "roll", 60);
  const pitch = levelSlider("Pitch", "pitch", 90);
  const source = h("p", { role: "status", "data-testid": "up-source" });
  const propose = button("Propose", "estimate-up", () => void estimateUp());
  const accept = button("Keep this level", "keep-up", () => save("up", { up }));
  const refuse = button("Refuse", "refuse-up", discard);
  const unknown = button("Clear", "clear-up", () => save("up", { up: null }));
  unknown.title = "Take it from the recording's files again; if they do not tell, it is unknown";
  const follows = h("p", { class: "help", "data-testid": "up-effect" });
  const recordings = h("select", { "data-testid": "alignment-recording", onchange: () => void openRecording() });
  const showPoints = h("input", { type: "checkbox", checked: true, onchange: display, "data-testid": "show-points" });
  const showLevel = h("input", { type: "checkbox", checked: true, onchange: display, "data-testid": "show-level" });
  const pointSize = h("input", { type: "range", min: 1, max: 8, step: 0.5, value: "2", oninput: display });
  // what is set before the recording is known would be lost
  const aside = h(
    "div",
    { class: "aside", inert: true },
    panel(
      "Calibration",
      [...turns, ...shifts, offset].map((each) => each.root).concat(noTimes, offsetNote),
      [keep, back, zero],
      effect,
    ),
    panel("Which way is up", [source, roll.root, pitch.root], [propose, accept, refuse, unknown], follows),
  );
  const picture = createPicture(host, (url) => void explain(url));
  const frameProblem = createFrameProblem(host, {
    onRetry: () => void load(),
    onStep: (which) => void leaveBroken(which),
  });

  root.append(
    h(
      "div",
      { class: "alignment-mode", "data-testid": "alignment" },
      h(
        "section",
        { class: "panel" },
        h(
          "header",
          {},
          h("h2", { class: "ellipsis" }, "Cloud over image"),
          recordings,
          h("span", { class: "grow" }),
          h("label", { class: "row" }, showPoints, "points"),
          h("label", { class: "row", title: "Size of the points" }, pointSize),
          h("label", { class: "row" }, showLevel, "level"),
        ),
        problem,
        host,
        h(
          "footer",
          { class: "help" },
          "Near points are red, far ones blue. The wheel zooms; drag to move the picture.",
        ),
      ),
      aside,
    ),
  );

  /**
   * @param {string} title
   * @param {HTMLElement[]} parts
   * @param {HTMLElement[]} buttons
   * @param {HTMLElement} help
   */
  function panel(title, parts, buttons, help) {
    const body = h("div", { class: "body stack" }, parts, h("div", { class: "row wrap" }, buttons), help);
    return h("section", { class: "panel" }, h("header", {}, h("h2", {}, title)), body);
  }

  /**
   * @param {string} label
   * @param {string} testid
   * @param {() => void} onclick
   */
  function button(label, testid, onclick) {
    return h("button", { type: "button", "data-testid": testid, onclick }, label);
  }

  /**
   * @param {string} label
   * @param {string} testid
   * @param {number} most
   * @param {number} step
   * @param {string} unit
   */
  function slider(label, testid, most, step, unit) {
    return createSlider({ label, testid, most, step, unit, onChange: show });
  }

  /**
   * @param {string} label
   * @param {string} testid
   * @param {number} most
   */
  function levelSlider(label, testid, most) {
    const onChange = () => {
      estimate = null;
      up = upOf({ roll: roll.value, pitch: pitch.value });
      show();
    };
    return createSlider({ label, testid, most, step: 0.1, unit: "°", onChange });
  }

  /** @returns {Api.CorrectionJson} */
  function correction() {
    const [x, y, z] = turns.map(({ value }) => value);
    const [right, down, ahead] = shifts.map(({ value }) => value);
    return { turn_deg: [x, y, z], shift_m: [right, down, ahead], time_offset_s: offset.value };
  }

  /**
   * The shown level in the camera frame of a correction.
   *
   * @param {Api.CorrectionJson} after
   */
  function turnedUp(after) {
    if (known === null || up === null) return null;
    const turn = multiply(rotationOf(after.turn_deg), transpose(rotationOf(known.correction.turn_deg)));
    const shown = up;
    return turn.map((row) => dot(row, shown));
  }

  function isCorrectionChanged() {
    if (known === null) return false;
    const [a, b] = [flat(correction()), flat(known.correction)];
    return a.some((value, i) => Math.abs(value - b[i]) > SAME);
  }

  function isUpChanged() {
    if (known === null || up === null) return false;
    const before = known.up;
    return before === null || dot(up, before) < 1 - SAME;
  }

  function hasUnsaved() {
    return isCorrectionChanged() || (estimate === null && isUpChanged());
  }

  /** The frame whose image the time offset shows. */
  function imageFrame() {
    if (known === null) return frame;
    const wanted = -offset.value;
    const nearest = known.images.toSorted((a, b) => Math.abs(a.seconds - wanted) - Math.abs(b.seconds - wanted))[0];
    return nearest === undefined ? frame : nearest.frame;
  }

  function show() {
    if (ended || known === null || frame === null) return;
    const { camera, width, height, labels, drawn_images: drawn, is_virtual: isVirtual } = known;
    picture.set({
      image: app.path("frames", imageFrame() ?? frame, "recorded.jpg"),
      camera: { ...camera, width, height },
      points: moved(points, correction()),
      up: turnedUp(correction()),
      isFirm: !isUpChanged(),
    });
    const isOff = isBusy || isBroken;
    keep.disabled = back.disabled = isOff || !isCorrectionChanged();
    zero.disabled = isOff || flat(known.correction).every((value) => value === 0);
    accept.disabled = isOff || !isUpChanged();
    refuse.disabled = isOff || (estimate === null && !isUpChanged());
    unknown.disabled = isOff || known.up_source !== "project";
    propose.disabled = isBusy;
    for (const { root: row } of [...turns, ...shifts]) row.hidden = isVirtual;
    keep.hidden = back.hidden = isVirtual;
    zero.hidden = isVirtual && zero.disabled;
    offset.root.hidden = isVirtual || known.images.length === 0;
    noTimes.hidden = isVirtual || known.images.length > 0;
    effect.textContent = isVirtual
      ? "The image is drawn from the cloud itself, so there is no calibration to correct."
      : `For all frames of ${known.name}: ${count(labels, "3D box", "3D boxes")} and the boxes on pseudo-views stay ` +
        "where they are in the cloud, so they move on the image with it; outlines and 2D boxes are projected anew. " +
        "Boxes drawn on images stay. The next training makes its pictures anew. Undo restores everything.";
    offsetNote.textContent =
      `${count(drawn, "frame has", "frames have")} boxes that were drawn on the image. With this time offset ` +
      "they are on another image: draw them again.";
    offsetNote.hidden = drawn === 0 || offset.value === known.correction.time_offset_s;
    source.textContent = describeUp();
    follows.textContent =
      "Stored boxes do not change. New boxes, views and proposals follow: " +
      `the project's rotation setting is ${app.state.project.settings.rotation} ` +
      "(auto: upright where up is known).";
  }

  function describeUp() {
    if (known === null) return "";
    if (estimate !== null && estimate.up === null) return `No proposal: ${estimate.reason}.`;
    if (estimate !== null) {
      const isSet = isUpChanged() ? "" : " It is set already.";
      const spread = estimate.spread_deg.toFixed(1);
      return (
        `Proposed with certainty ${estimate.certainty.toFixed(2)}: ${estimate.reason}; ` +
        `${estimate.agreeing} of ${count(estimate.frames, "frame")} agree within ${spread}°.${isSet}`
      );
    }
    if (isUpChanged()) return "Turned by hand, not kept yet (dashed).";
    const words = {
      unknown: "Not known: boxes may have any rotation. Propose a level, or turn one by hand.",
      files: "Known from the recording's files.",
      project: "Set in this project.",
    };
    return words[known.up_source];
  }

  function display() {
    picture.setShow({ points: showPoints.checked, level: showLevel.checked, size: Number(pointSize.value) });
  }

  /** Shows what is stored. */
  function reset() {
    if (known === null) return;
    estimate = null;
    setUp(known.up);
    setSliders(known.correction);
  }

  function discard() {
    reset();
    if (isOutdated) void load();
  }

  /** @param {Vector | null} next */
  function setUp(next) {
    up = next;
    const { roll: rolled, pitch: pitched } = anglesOf(next ?? [0, -1, 0]);
    roll.set(rolled);
    pitch.set(pitched);
  }

  /**
   * Shows an answer. On another frame with the same adjustment, what was not kept yet stays.
   *
   * @param {Api.AlignmentJson} answer
   */
  function take(answer) {
    const isSame = known?.recording === answer.recording && known.adjusted === answer.adjusted;
    // what was not changed is as this frame has it: the files may know another up direction for each
    const [sliders, level, proposed] = [
      isCorrectionChanged() ? correction() : null,
      isUpChanged() ? up : null,
      estimate,
    ];
    known = answer;
    isOutdated = false;
    const flatPoints = answer.points;
    points = Array.from({ length: flatPoints.length / 3 }, (_, i) => flatPoints.slice(3 * i, 3 * i + 3));
    problem.hidden = true;
    aside.inert = false;
    recordings.value = String(answer.recording);
    reset();
    if (isSame) putBack(sliders, level, proposed);
  }

  /**
   * @param {Api.CorrectionJson | null} sliders null: as stored.
   * @param {Vector | null} level null: as stored.
   * @param {Api.EstimatedUp | null} proposed
   */
  function putBack(sliders, level, proposed) {
    estimate = proposed;
    if (level !== null) setUp(level);
    if (sliders !== null) setSliders(sliders);
    show();
  }

  /** @param {unknown} error */
  function fail(error) {
    if (ended || isAborted(error)) return;
    problem.textContent = messageOf(error);
    problem.hidden = false;
  }

  async function load() {
    try {
      frame ??= await firstFrame();
      if (frame === null) throw new Error("The project has no recording yet; add one on the start page.");
      const own = frame;
      await app.loadFrame(own);
      /** @type {Api.AlignmentJson} */
      const answer = await app.api.get(app.path("frames", own, "alignment"));
      if (ended || own !== frame) return;
      isBroken = false;
      frameProblem.hide();
      take(answer);
    } catch (error) {
      if (ended || isAborted(error)) return;
      isBroken = frame !== null;
      if (isBroken) frameProblem.show(error);
      else fail(error);
      show();
    }
  }

  /** @param {Direction} which */
  async function leaveBroken(which) {
    const beside = frame === null ? null : await frameBeside(app, frame, which);
    if (beside !== null) app.go(makeHash(app.state.project.name, "alignment", beside));
  }

  /**
   * Says why an image could not be loaded.
   *
   * @param {string} url
   */
  async function explain(url) {
    try {
      await app.api.get(url);
      fail(new Error("The image of this frame cannot be shown."));
    } catch (error) {
      fail(error);
    }
  }

  /** @param {string} [recording] */
  async function firstFrame(recording = "") {
    const of = recording === "" ? "" : `&recording=${recording}`;
    /** @type {Api.FrameListJson} */
    const { frames } = await app.api.get(`${app.path("frames")}?limit=1${of}`);
    return frames[0]?.id ?? null;
  }

  async function openRecording() {
    const question = "The correction or the level was not kept.";
    if (hasUnsaved() && !(await confirm("Another recording", question, "Discard it", "danger"))) {
      recordings.value = String(known?.recording);
      return;
    }
    const first = await firstFrame(recordings.value);
    if (first !== null) app.go(makeHash(app.state.project.name, "alignment", first));
  }

  /**
   * Keeps the level or the correction; the other one stays as it is shown.
   *
   * @param {"up" | "correction"} what
   * @param {{ up?: Vector | null, correction?: Api.CorrectionJson }} content
   */
  async function save(what, content) {
    if (known === null || frame === null || isBusy) return;
    const own = frame;
    const sliders = content.correction === undefined ? correction() : null;
    const level = content.correction !== undefined && isUpChanged() ? turnedUp(content.correction) : null;
    const proposed = content.correction === undefined ? null : estimate;
    isBusy = true;
    show();
    try {
      app.effort.action();
      const path = app.path("recordings", known.recording, what);
      /** @type {Api.AlignmentJson} */
      const answer = await app.api.change(path, { ...content, frame: own, adjusted: known.adjusted });
      isBusy = false;
      if (ended) return;
      take(answer);
      putBack(sliders, level, proposed);
      if (own === frame) await app.loadFrame(own);
      else await load();
    } catch (error) {
      fail(error);
    } finally {
      isBusy = false;
      show();
    }
  }

  /** @param {Api.CorrectionJson} values */
  function setSliders({ turn_deg, shift_m, time_offset_s }) {
    for (const i of [0, 1, 2]) {
      turns[i].set(turn_deg[i]);
      shifts[i].set(shift_m[i]);
    }
    offset.set(time_offset_s);
    show();
  }

  async function estimateUp() {
    if (known === null || isBusy) return;
    const asked = known;
    isBusy = true;
    show();
    source.textContent = "Looking at some frames …";
    try {
      /** @type {Api.EstimatedUp} */
      const found = await app.api.post(app.path("recordings", asked.recording, "estimate-up"), {});
      // another recording may be shown by now, or its clouds may have been turned
      if (ended || known.recording !== asked.recording || known.adjusted !== asked.adjusted) return;
      estimate = found;
      if (estimate.up !== null) setUp(estimate.up);
    } catch (error) {
      fail(error);
    } finally {
      isBusy = false;
      show();
    }
  }

  /** @param {Messages["adjusted"]} message */
  function onAdjusted({ recording, adjusted, operator }) {
    if (known?.recording !== recording || adjusted <= known.adjusted) return;
    isOutdated = true;
    if (isBusy) return;
    if (isCorrectionChanged() || isUpChanged())
      app.toast(`${operator} has adjusted this recording meanwhile. Discard your changes to see it.`, "warn");
    else void load();
  }

  /** Asks whether the recording was adjusted while there was no connection. */
  async function onReconnected() {
    if (known === null || frame === null) return;
    try {
      /** @type {Api.AlignmentJson} */
      const { recording, adjusted } = await app.api.get(app.path("frames", frame, "alignment"));
      if (!ended) onAdjusted({ recording, adjusted, operator: "Someone" });
    } catch (error) {
      fail(error);
    }
  }

  const stops = [app.events.on("adjusted", onAdjusted), app.events.on("reconnected", onReconnected)];

  recordings.append(...app.state.project.recordings.map(({ id, name }) => h("option", { value: String(id) }, name)));
  void load();
  return {
    /** @param {Route} route */
    route(route) {
      if (route.frame === frame) return;
      frame = route.frame;
      void load();
    },
    unsaved: () =>
      hasUnsaved() ? { text: "The correction or the level was not kept.", retry: () => {}, discard } : null,
    unmount() {
      ended = true;
      for (const stop of stops) stop();
      picture.close();
    },
  };
}

/** @param {Api.CorrectionJson} correction */
const flat = ({ turn_deg, shift_m, time_offset_s }) => [...turn_deg, ...shift_m, time_offset_s];
