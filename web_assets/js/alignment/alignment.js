/**
 * Alignment: how the cloud of a recording lies on its image, and which way is up. What is set here holds for all
 * frames of the recording, and can be undone.
 */

import { confirm } from "../dialogs.js";
import { h } from "../dom.js";
import { isAborted } from "../errors.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { createCorrectionPanel } from "./correction_panel.js";
import { createLevelPanel } from "./level_panel.js";
import { createPicture, moved } from "./picture.js";

const NOT_KEPT = "The correction or the level is not kept yet.";

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  /** @type {Api.AlignmentJson | null} */
  let known = null;
  /** @type {Vector[]} */
  let points = [];
  let frame = app.state.route.frame;
  let isBusy = false;
  /** Someone else has adjusted the recording since it was shown. */
  let isOutdated = false;
  /** The frame cannot be read. */
  let isBroken = false;

  const correction = createCorrectionPanel({
    onChange: show,
    onKeep: (value) => keep("correction", { correction: value }),
    onDiscard: discard,
  });
  const level = createLevelPanel({
    rotation: () => app.state.project.settings.rotation,
    onChange: show,
    onPropose: () => void estimateUp(),
    onKeep: (up) => keep("up", { up }),
    onDiscard: discard,
  });
  const picture = createPicture({ onMissing: (url) => void explain(url) });
  const frameProblem = createFrameProblem(picture.host, {
    onRetry: () => void load(),
    onStep: (which) => void leaveBroken(which),
  });
  // what is set before the recording is known would be lost
  const aside = h("div.aside", { inert: true }, correction.root, level.root);
  root.append(h("div.alignment-mode", { "data-testid": "alignment" }, picture.root, aside));

  function hasUnsaved() {
    return correction.isChanged() || level.isUnsaved();
  }

  function show() {
    if (until.aborted || known === null || frame === null) return;
    const { camera, width, height } = known;
    const value = correction.value();
    picture.set({
      image: app.path("frames", correction.imageFrame() ?? frame, "recorded.jpg"),
      camera: { ...camera, width, height },
      points: moved(points, value),
      up: level.turned(value),
      isFirm: level.isKept(),
    });
    const isOff = isBusy || isBroken;
    correction.show(isOff);
    level.show(isOff, isBusy);
  }

  /** Shows what is stored. */
  function reset() {
    if (known === null) return;
    correction.take(known);
    level.take(known);
    show();
  }

  function discard() {
    reset();
    if (isOutdated) void load();
  }

  /** Shows an answer. On another frame with the same adjustment, what was not kept yet stays. */
  function take(/** @type {Api.AlignmentJson} */ answer) {
    const isSame = known?.recording === answer.recording && known.adjusted === answer.adjusted;
    // what was not changed is as this frame has it: the files may know another up direction for each
    const sliders = correction.isChanged() ? correction.value() : null;
    const [up, proposed] = [level.changed(), level.estimate];
    known = answer;
    isOutdated = false;
    const flatPoints = answer.points;
    points = Array.from({ length: flatPoints.length / 3 }, (_, i) => flatPoints.slice(3 * i, 3 * i + 3));
    picture.setProblem(null);
    aside.inert = false;
    reset();
    if (isSame) putBack(sliders, up, proposed);
  }

  /**
   * @param {Api.CorrectionJson | null} sliders null: as stored.
   * @param {Vector | null} up null: as stored.
   * @param {Api.EstimatedUp | null} proposed
   */
  function putBack(sliders, up, proposed) {
    level.put(up, proposed);
    if (sliders !== null) correction.set(sliders);
    show();
  }

  function fail(/** @type {unknown} */ error) {
    if (until.aborted || isAborted(error)) return;
    picture.setProblem(error);
  }

  async function load() {
    try {
      frame ??= await app.api.get(app.path("first-frame"));
      if (frame === null) throw new Error("The project has no recording yet; add one on the start page.");
      const own = frame;
      await app.loadFrame(own);
      const answer = await app.api.get(app.path("frames", own, "alignment"));
      if (until.aborted || own !== frame) return;
      isBroken = false;
      frameProblem.hide();
      take(answer);
    } catch (error) {
      if (until.aborted || isAborted(error)) return;
      isBroken = frame !== null;
      if (isBroken) frameProblem.show(error);
      else fail(error);
      show();
    }
  }

  async function leaveBroken(/** @type {Direction} */ which) {
    const beside = frame === null ? null : await frameBeside(app, frame, which);
    if (beside !== null) app.go(makeHash(app.state.project.name, "alignment", beside));
  }

  /** What is not kept stays on the other frames of the recording; in another one it would be lost. */
  async function openFrame(/** @type {number | null} */ wanted) {
    if (wanted === frame) return;
    const isSame = wanted !== null && app.state.timeline?.places.has(wanted);
    if (!isSame && hasUnsaved() && !(await confirm("Another recording", NOT_KEPT, "Discard it", "danger"))) {
      if (frame !== null) app.stay(frame);
      return;
    }
    frame = wanted;
    void load();
  }

  /** Says why an image could not be loaded. */
  async function explain(/** @type {string} */ url) {
    try {
      await app.api.get(url);
      fail(new Error("The image of this frame cannot be shown."));
    } catch (error) {
      fail(error);
    }
  }

  /**
   * Keeps the level or the correction; the other one stays as it is shown. Throws the reason why it cannot be kept.
   */
  async function save(
    /** @type {"up" | "correction"} */ what,
    /** @type {{ up?: Vector | null, correction?: Api.CorrectionJson }} */ content,
  ) {
    if (known === null || frame === null || isBusy) return;
    const own = frame;
    const sliders = content.correction === undefined ? correction.value() : null;
    const up = content.correction !== undefined && level.isChanged() ? level.turned(content.correction) : null;
    const proposed = content.correction === undefined ? null : level.estimate;
    isBusy = true;
    show();
    try {
      app.effort.action();
      const path = app.path("recordings", known.recording, what);
      const answer = await app.api.change(path, { ...content, frame: own, adjusted: known.adjusted });
      isBusy = false;
      if (until.aborted) return;
      take(answer);
      putBack(sliders, up, proposed);
      if (own === frame) await app.loadFrame(own);
      else await load();
    } finally {
      isBusy = false;
      show();
    }
  }

  /** Keeps what is not kept yet; throws the reason why it cannot be kept. */
  async function keepAll() {
    if (correction.isChanged()) await save("correction", { correction: correction.value() });
    if (level.isUnsaved()) await save("up", { up: level.changed() });
  }

  /** As `save`, but shows the reason. */
  const keep = (/** @type {Parameters<typeof save>} */ ...what) => save(...what).catch(fail);

  async function estimateUp() {
    if (known === null || isBusy) return;
    const asked = known;
    isBusy = true;
    show();
    level.wait();
    try {
      const found = await app.api.post(app.path("recordings", asked.recording, "estimate-up"), {});
      // another recording may be shown by now, or its clouds may have been turned
      if (until.aborted || known.recording !== asked.recording || known.adjusted !== asked.adjusted) return;
      level.put(found.up, found);
    } catch (error) {
      fail(error);
    } finally {
      isBusy = false;
      show();
    }
  }

  function onAdjusted(/** @type {Messages["adjusted"]} */ { recording, adjusted, operator }) {
    if (known?.recording !== recording || adjusted <= known.adjusted) return;
    isOutdated = true;
    if (isBusy) return;
    if (correction.isChanged() || level.isChanged())
      app.toast(`${operator} has adjusted this recording meanwhile. Discard your changes to see it.`, "warn");
    else void load();
  }

  /** Asks whether the recording was adjusted while there was no connection. */
  async function onReconnected() {
    if (known === null || frame === null) return;
    try {
      const { recording, adjusted } = await app.api.get(app.path("frames", frame, "alignment"));
      if (!until.aborted) onAdjusted({ recording, adjusted, operator: "Someone" });
    } catch (error) {
      fail(error);
    }
  }

  app.events.on("adjusted", onAdjusted, until);
  app.events.on("reconnected", onReconnected, until);
  until.addEventListener("abort", picture.close);

  void load();
  return {
    route: (/** @type {Route} */ route) => void openFrame(route.frame),
    unsaved: () => (hasUnsaved() ? { text: NOT_KEPT, retry: keepAll, action: "Keep and continue", discard } : null),
  };
}
