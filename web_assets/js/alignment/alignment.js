/**
 * Alignment: how the cloud of a recording lies on its image, and which way is up. What is set here holds for all
 * frames of the recording, and can be undone.
 */

import { confirm } from "../dialogs.js";
import { h, nothing } from "../dom.js";
import { isAborted } from "../errors.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { createControls } from "./controls.js";
import { createPicture, moved } from "./picture.js";
import * as settings from "./setting.js";
import { anglesOf, upOf } from "./level.js";

const NOT_KEPT = "The correction or the level is not kept yet.";

/** @type {Mode["mount"]} */
export function mount(root, app, until) {
  /** @type {import("./setting.js").Setting | null} */
  let setting = null;
  /** @type {Camera} */
  let camera;
  /** @type {Vector[]} */
  let points = [];
  let frame = app.state.route.frame;
  /** @type {import("./controls.js").Busy} */
  let busy = null;
  /** Who has adjusted the recording since it was shown. @type {string | null} */
  let outdatedBy = null;
  /** The frame cannot be read. */
  let isBroken = false;

  const controls = createControls({
    rotation: () => app.state.project.settings.rotation,
    change(changes) {
      if (setting !== null) setting = { ...setting, ...changes };
      show();
    },
    propose,
    keep,
    discard,
  });
  const picture = createPicture({ onMissing: (url) => void explain(url) });
  const frameProblem = createFrameProblem(picture.host, {
    onRetry: () => void load(),
    onStep: (which) => void leaveBroken(which),
  });
  root.append(h("div.alignment-mode", { "data-testid": "alignment" }, picture.root, controls.root));

  const hasUnsaved = () => setting !== null && (settings.isCorrected(setting) || settings.isTurnedByHand(setting));

  function show() {
    if (until.aborted || setting === null || frame === null) return;
    const { stored } = setting;
    picture.set({
      image: app.path("frames", settings.imageFrame(setting) ?? frame, "recorded.jpg"),
      camera,
      points: moved(points, settings.correctionOf(setting)),
      up: settings.turnedUp(setting),
      isFirm: stored.up !== null && !settings.isTurned(setting),
    });
    controls.show(setting, busy, isBroken);
  }

  /** Shows what is stored. */
  function discard() {
    if (setting !== null) setting = settings.asStored(setting.stored);
    show();
    if (outdatedBy !== null) void load();
  }

  function take(/** @type {import("./setting.js").Setting} */ next) {
    const { camera: lens, width, height, points: flatPoints } = next.stored;
    setting = next;
    outdatedBy = null;
    camera = { ...lens, width, height };
    points = Array.from({ length: flatPoints.length / 3 }, (_, i) => flatPoints.slice(3 * i, 3 * i + 3));
    show();
  }

  async function load() {
    try {
      frame ??= await app.api.get(app.path("first-frame"));
      if (until.aborted) return;
      if (frame === null) {
        const text = "The cloud over the image is shown once the project has a recording.";
        return root.replaceChildren(nothing("No recording yet", text, "#/", "All projects"));
      }
      const own = frame;
      await app.loadFrame(own);
      const answer = await app.api.get(app.path("frames", own, "alignment"));
      if (until.aborted || own !== frame) return;
      isBroken = false;
      frameProblem.hide();
      take(settings.taken(setting, answer));
    } catch (error) {
      if (until.aborted || isAborted(error)) return;
      isBroken = true;
      frameProblem.show(error);
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
    await app.api.get(url);
    throw new Error("The image of this frame cannot be shown.");
  }

  /** Shows that something is being done until it is. */
  async function during(/** @type {NonNullable<typeof busy>} */ what, /** @type {() => Promise<unknown>} */ act) {
    busy = what;
    show();
    try {
      await act();
    } finally {
      busy = null;
      show();
      catchUp();
    }
  }

  /** Keeps the level or the correction; the other one stays as it is shown. Throws the reason why it cannot be kept. */
  async function keep(/** @type {{ correction: Api.CorrectionJson } | { up: Vector | null }} */ content) {
    if (setting === null || frame === null || busy !== null) return;
    const own = frame;
    const what = "up" in content ? "up" : "correction";
    const { recording, adjusted } = setting.stored;
    await during("keeping", async () => {
      app.effort.action();
      const path = app.path("recordings", recording, what);
      const answer = await app.api.change(path, { ...content, frame: own, adjusted });
      if (until.aborted || setting === null) return;
      take(settings.kept(setting, answer, what));
      if (own === frame) await app.loadFrame(own);
      else await load();
    });
  }

  /** Keeps what is not kept yet; throws the reason why it cannot be kept. */
  async function keepAll() {
    if (setting && settings.isCorrected(setting)) await keep({ correction: settings.correctionOf(setting) });
    if (setting && settings.isTurnedByHand(setting)) await keep({ up: upOf(settings.levelOf(setting)) });
  }

  async function propose() {
    if (setting === null || busy !== null) return;
    const { recording, adjusted } = setting.stored;
    await during("proposing", async () => {
      const proposed = await app.api.post(app.path("recordings", recording, "estimate-up"), {});
      // another recording may be shown by now, or its clouds may have been turned
      if (setting?.stored.recording !== recording || setting.stored.adjusted !== adjusted) return;
      setting = { ...setting, proposed, level: proposed.up ? anglesOf(proposed.up) : setting.level };
    });
  }

  function onAdjusted(/** @type {Messages["adjusted"]} */ { recording, adjusted, operator }) {
    if (setting?.stored.recording !== recording || adjusted <= setting.stored.adjusted) return;
    outdatedBy = operator;
    catchUp();
  }

  /** Shows what others have adjusted, once nothing is being done, or says so where something would be lost. */
  function catchUp() {
    if (until.aborted || setting === null || outdatedBy === null || busy !== null) return;
    if (settings.isCorrected(setting) || settings.isTurned(setting))
      app.toast(`${outdatedBy} has adjusted this recording meanwhile. Discard your changes to see it.`, "warn");
    else void load();
  }

  /** Asks whether the recording was adjusted while there was no connection. */
  async function onReconnected() {
    if (setting === null || frame === null) return;
    const { recording, adjusted } = await app.api.get(app.path("frames", frame, "alignment"));
    if (!until.aborted) onAdjusted({ recording, adjusted, operator: "Someone" });
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
