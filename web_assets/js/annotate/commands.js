/** What the keys and buttons of Annotate do. */

import { headingTurned, sameBox } from "../box3d.js";
import { askClass } from "../classes/picker.js";
import { confirm } from "../dialogs.js";
import { count } from "../dom.js";
import { currentFrame } from "../frame_state.js";
import { makeHash } from "../router.js";
import { isOpen } from "./desk.js";
import { mostDoubtful } from "./opening.js";
import { copiedText, OPERATIONS } from "./tracks.js";

const CHECK_PLACED = "Check its distance and heading, or label it in a frame that shows more of it.";
const LABEL_ELSEWHERE =
  "Label the object in a frame that shows more of it; then copy its box here (C: from the previous frame), or fill " +
  "the frames between two reviewed boxes of its track.";

const sentence = (/** @type {string} */ text) => `${text[0].toUpperCase()}${text.slice(1)}`;

export function createCommands(/** @type {Annotate} */ at) {
  const { app, desk, queue, opening } = at;
  let isPlacing = false;
  /**
   * The box of what nobody labelled that was offered last, and how far away it is.
   *
   * @type {{ frame: number | null, beyond: number, uid: string | null }}
   */
  let standing = { frame: null, beyond: 0, uid: null };
  /** How often what was refused was shown again. */
  let refused = 0;
  /** The cameras to which a key went for the selected box. @type {{ uid: string | null, seen: Set<number> }} */
  let tour = { uid: null, seen: new Set() };

  function stepBox(/** @type {number} */ by) {
    const uids = desk.labels().map(({ uid }) => uid);
    if (uids.length === 0) return;
    const at = uids.indexOf(desk.uid ?? "");
    desk.select(uids[at < 0 ? (by > 0 ? 0 : uids.length - 1) : (at + by + uids.length) % uids.length]);
  }

  /**
   * What is reviewed after a decision. In the queue, its next item; but a box that is removed never takes the operator
   * to another frame. Otherwise the most doubtful open box of the frame: one that was opened by itself is never left.
   *
   * @returns {Target | null}
   */
  function nextAfter(/** @type {"accept" | "reject" | "delete"} */ kind, /** @type {PageLabel} */ label) {
    const { id: frame } = currentFrame(app).frame;
    const next = queue.after(label.uid, frame);
    const isRemoved = kind === "delete" || (kind === "reject" && label.isNew);
    // a frame to draw on is left only when asked: it may have more objects
    const isBox = next === null || next.uid !== null;
    if (opening.inQueue && isBox && (!isRemoved || (next && desk.stored(next.uid)))) return next;
    return openHere(label.uid);
  }

  /** The most doubtful open box of the frame, but not this one. @returns {Target | null} */
  function openHere(/** @type {string | null} */ but = null) {
    const open = mostDoubtful(desk.labels().filter((one) => isOpen(one) && one.uid !== but));
    return open ? { frame: currentFrame(app).frame.id, uid: open.uid } : null;
  }

  /** Selects the most doubtful open box of the frame if nothing is selected, or else goes on in the queue. */
  function goOn() {
    const next = openHere() ?? (opening.inQueue ? queue.after(null, opening.opened) : null);
    if (next) void opening.go(next, opening.inQueue);
    else sayReviewed();
  }

  const sayReviewed = () =>
    app.toast("All boxes of this frame are reviewed. N: the next frame. A click in the queue goes on there.");

  /**
   * Accepts, rejects or deletes the selected box, and goes to the next one. Saving a draft counts as accepting. A new
   * box stays selected when it is accepted, since the next step is often to follow it.
   */
  async function decide(/** @type {"accept" | "reject" | "delete"} */ kind) {
    if (opening.loading || !app.state.frame) return;
    if (kind === "accept" && at.teach.accept()) return;
    // it means the box that is being drawn or found, and not the one that was selected before
    if (kind === "accept" && at.image.isBusy) return;
    if (kind === "delete" && at.teach.removeDrawn()) return;
    const label = desk.shown;
    if (!label) return kind === "accept" ? goOn() : undefined;
    const { id: frame } = currentFrame(app).frame;
    const before = opening.openings;
    const next = kind === "accept" && label.isNew ? null : nextAfter(kind, label);
    if (!next && kind === "accept" && isReviewed(label)) sayReviewed();
    const isHere = next !== null && opening.isShown(next.uid);
    const isAtOnce = !isHere && next !== null && label.state !== "rejected" && mayGoOn(next.frame, label.uid);
    const saved = save(kind, label);
    if (isAtOnce) return goOnBefore(saved, label.uid, next);
    // a box that the image shows is selected at once; another camera, or what the change moves, is opened after saving
    if (isHere) desk.select(next.uid);
    else if (next) opening.setLoading(true);
    const isSaved = await saved;
    // the operator has opened another frame in the meantime
    if (before !== opening.openings) return;
    if (!isSaved) {
      opening.setLoading(false);
      if (app.state.frame?.frame.id === frame) desk.select(label.uid);
      return;
    }
    if (next && !isHere) {
      // others may have moved it, so that this camera sees it best now
      if (opening.isShown(next.uid)) opening.setLoading(false);
      await opening.go(next, opening.inQueue);
    } else if (!next && kind !== "accept") opening.pick(null);
  }

  /** Whether a frame can be opened before the change that is about to be sent is saved: it does not depend on it. */
  const mayGoOn = (/** @type {number} */ frame, /** @type {string} */ uid) =>
    !Object.values(currentFrame(app).frame.cameras).includes(frame) &&
    desk.mayGoOn(frame, uid) &&
    at.teach.unsaved === null &&
    !at.image.isBusy;

  /** Opens the queue's next box while the one before is being saved; if that is refused, it is shown again. */
  async function goOnBefore(
    /** @type {Promise<boolean>} */ saved,
    /** @type {string} */ uid,
    /** @type {Target} */ next,
  ) {
    const { id: frame } = currentFrame(app).frame;
    const [isFromQueue, refusals] = [opening.inQueue, refused];
    queue.leave(uid);
    void opening.go(next, isFromQueue, true);
    const isSaved = await saved;
    if (!at.parts.root.isConnected) return;
    // what is refused is in the queue again; the server knows it if the frame cannot be read
    await app.frames.of(frame).then(
      (state) => queue.settle(state),
      () => queue.reloadSoon(),
    );
    // if several were refused, the first of them is shown
    if (isSaved || refusals !== refused) return;
    refused += 1;
    await opening.go({ frame, uid }, isFromQueue);
  }

  const isReviewed = (/** @type {PageLabel} */ { state }) => state === "accepted" || state === "edited";

  async function save(/** @type {"accept" | "reject" | "delete"} */ kind, /** @type {PageLabel} */ label) {
    // a new box is stored together with its draft
    if (kind === "accept" && desk.hasDraft && !label.isNew) {
      const isSaved = await desk.commit();
      const stored = desk.stored(label.uid);
      return isSaved && stored && !isReviewed(stored) ? desk.decide("accept", label.uid) : isSaved;
    }
    if (kind === "accept" && isReviewed(label)) return true;
    if (kind === "reject" && label.state === "rejected") return true;
    return desk.decide(kind, label.uid);
  }

  /** Accepts the frame's proposals, whose small pictures are in its list; in the queue, goes to its next frame. */
  async function acceptAll() {
    const label = desk.shown;
    if (!label) return;
    const before = opening.openings;
    if (!(await desk.commit()) || !(await desk.acceptAll()) || before !== opening.openings) return;
    const next = openHere() ?? (opening.inQueue ? queue.after(label.uid, opening.opened) : null);
    if (next) await opening.go(next, opening.inQueue);
  }

  async function refit() {
    const label = desk.shown;
    if (!label) return;
    const { id } = currentFrame(app).frame;
    const { box, note, measured_by } = await app.api.post(app.path("frames", id, "refit"), {
      box: label.box,
      label: label.label,
    });
    if (desk.uid !== label.uid) return;
    if (desk.shown && !sameBox(desk.shown.box, label.box))
      return app.toast("The box was changed during the fit. Press G to fit it again.", "warn");
    if (box) await desk.edit({ box });
    app.toast(note ?? `Fitted again. Measured by: ${measured_by}`, "info");
  }

  async function followOne(/** @type {"forward" | "backward"} */ direction) {
    // a new box is right when it is followed: it was just drawn
    if (desk.shown?.isNew && !(await desk.decide("accept", desk.shown.uid))) return;
    const label = desk.shown;
    if (label && isReviewed(label)) void at.follow.start(direction, label.uid);
    else app.toast("Select a reviewed box to follow, or accept this one first.", "warn");
  }

  const canDraw = () => app.state.frame !== null && !opening.loading && !app.state.frame.frame.finalised;

  /**
   * A box was drawn on the image. If no object is found in it, it becomes the first of five drags, on the image and on
   * the pseudo-views, unless it has too few points for views to draw on.
   */
  async function fitDrawn(/** @type {Box2D} */ box) {
    if (at.teach.isOn) return at.teach.draw(box);
    const { id } = currentFrame(app).frame;
    const answer = await app.api.post(app.path("frames", id, "fit"), { image_box: box });
    const { note, box: fitted, too_few_points, ...facts } = answer;
    if (app.state.frame?.frame.id !== id || !at.parts.root.isConnected)
      return app.toast("The frame was left before a 3D box was found for what was drawn. Draw it again.", "warn");
    const why = sentence(note ?? "no object was found");
    if (fitted) desk.add({ ...facts, box: fitted, label: box.label, image_box: box });
    if (too_few_points) app.toast(`${why}. ${fitted ? CHECK_PLACED : LABEL_ELSEWHERE}`, "warn");
    if (fitted || too_few_points) return;
    const who = facts.measured_by ? ` (${facts.measured_by})` : "";
    app.toast(`${why}${who}. To finish it by hand, draw its boxes on the pseudo-views.`, "warn");
    at.teach.draw(box);
  }

  /** A box of the next class is placed where the top view was clicked. */
  const placeAt = (/** @type {Vector} */ point) => offer("place", { point, label: at.picker.label });

  /** Adds a box of the next class that the server finds; returns its answer, or null if the frame was left. */
  async function offer(/** @type {"place" | "unlabelled"} */ what, /** @type {object} */ body) {
    // not twice by a double click
    if (!canDraw() || isPlacing) return null;
    isPlacing = true;
    const { id } = currentFrame(app).frame;
    try {
      /** @type {Api.FitOut & Partial<Api.UnlabelledOut>} */
      const answer = await app.api.post(app.path("frames", id, what), body);
      const { box, note, too_few_points: _, distance: __, label, ...facts } = answer;
      if (app.state.frame?.frame.id !== id || !at.parts.root.isConnected) return null;
      // one that was offered before, and neither taken nor corrected
      if (what === "unlabelled" && desk.uid === standing.uid && desk.isAsFound(desk.uid)) desk.drop(desk.uid);
      if (box) desk.add({ ...facts, box, label: label ?? at.picker.label, image_box: null });
      else app.toast(sentence(note ?? "nothing was placed"), "warn");
      return answer;
    } finally {
      isPlacing = false;
    }
  }

  /** Lets what nobody labelled stand out; then offers a box of the next of it, the nearest first. */
  async function nextUnlabelled() {
    if (app.viewport.showUnlabelled(true)) return;
    const { id } = currentFrame(app).frame;
    const { beyond } = standing.frame === id ? standing : { beyond: 0 };
    const answer = await offer("unlabelled", { beyond });
    if (answer === null) return;
    standing = { frame: id, beyond: answer.box ? (answer.distance ?? 0) : 0, uid: answer.box ? desk.uid : null };
    if (answer.box) app.viewport.look("focus");
    else app.viewport.showUnlabelled(false);
  }

  async function copy() {
    if (app.state.frame?.frame.previous == null) return;
    const copies = await desk.copyPrevious();
    desk.select(copies[0].uid);
    app.toast(...copiedText(copies));
  }

  async function finalise() {
    if (!app.state.frame) return;
    const { frame } = app.state.frame;
    const left = desk.labels().filter(isOpen).length;
    const text = `${count(left, "proposal")} of this frame ${left === 1 ? "is" : "are"} not reviewed yet.`;
    if (!frame.finalised && left > 0 && !(await confirm("Finalise the frame", text, "Finalise anyway"))) return;
    if (await desk.finalise(!frame.finalised))
      app.toast(frame.finalised ? "The frame is reopened." : "The frame is finalised.", "good");
  }

  function setClass(/** @type {string | null | undefined} */ name) {
    if (!name) return;
    at.picker.pick(name);
    if (at.image.setClass(name) || at.teach.setClass(name)) return;
    if (desk.shown && desk.shown.label !== name) void desk.edit({ label: name });
  }

  /** Cancels a drag, or else an edit that is not saved, or else deselects. */
  function cancel() {
    if (at.map.cancel() || at.ortho.cancel() || at.image.cancel() || at.teach.cancel()) return;
    if (desk.hasDraft) desk.revert();
    else desk.select(null);
  }

  /**
   * Goes to the next camera of the moment: to those that see the selected object, the best first, then to the others.
   */
  function nextCamera() {
    if (opening.opened === null) return;
    const uid = desk.uid;
    if (tour.uid !== uid) tour = { uid, seen: new Set() };
    tour.seen.add(opening.opened);
    const all = Object.values(currentFrame(app).frame.cameras);
    const at = all.indexOf(opening.opened);
    const ordered = [...(desk.shown?.seen_by ?? []), ...all.slice(at + 1), ...all.slice(0, at)];
    const next = ordered.find((frame) => !tour.seen.has(frame));
    if (next === undefined) tour.seen.clear();
    const target = next ?? ordered.find((frame) => frame !== opening.opened);
    if (target !== undefined) app.go(makeHash(app.state.project.name, "annotate", target));
  }

  /** Draws a new box on the image, or stops that. */
  const draw = () => (at.image.isDrawing || !canDraw() ? at.image.draw(null) : at.image.drawUsual());

  /** Turns the selected box by so many quarters. */
  const turn = (/** @type {number} */ quarters) =>
    desk.shown && desk.edit({ box: headingTurned(desk.shown.box, quarters) });

  /** What a key or button does, by its row in the table of keys. @type {Record<string, KeyHandler>} */
  const always = {
    accept: () => decide("accept"),
    reject: () => decide("reject"),
    delete: () => decide("delete"),
    refit,
    turn: () => turn(2),
    "turn-quarter": () => turn(1),
    class: (key) => setClass(app.state.project.classes[Number(key) - 1]),
    "class-search": async () => setClass(await askClass(app)),
    attribute: (key) => at.attributes.press(key),
    cancel,
    "next-box": () => stepBox(1),
    "previous-box": () => stepBox(-1),
    "next-frame": () => opening.step("next"),
    "previous-frame": () => opening.step("previous"),
    "draw-box": draw,
    "gizmo-translate": () => at.scene.setGizmo("translate"),
    "gizmo-rotate": () => at.scene.setGizmo("rotate"),
    "gizmo-off": () => at.scene.setGizmo("off"),
    fit: () => [at.image.editor, at.map, at.ortho, at.teach].map((part) => part.fit()),
    areas: at.areas.swap,
    "top-view": () => at.map.turn(!at.map.isShown),
    teach: () => at.teach.turn(!at.teach.isOn),
    "next-whole-box": () => at.teach.nextWhole(),
  };
  /** The same, but nothing while a frame is being opened. @type {Record<string, KeyHandler>} */
  const whenCalm = {
    "accept-all": acceptAll,
    finalise,
    "copy-previous": copy,
    follow: () => followOne("forward"),
    "follow-back": () => followOne("backward"),
    "follow-all": () => at.follow.start("forward", null),
    "follow-all-back": () => at.follow.start("backward", null),
    "copy-next": () => at.tracks.copyToNext(),
    sheet: () => at.sheet.show(),
    unlabelled: nextUnlabelled,
    "next-of-track": () => at.tracks.step(1),
    "previous-of-track": () => at.tracks.step(-1),
    "next-camera": nextCamera,
  };
  for (const [id, { key }] of Object.entries(OPERATIONS))
    if (key) whenCalm[`track-${id}`] = (digit) => at.tracks.operate(id, digit);

  const calm = (/** @type {KeyHandler} */ fn) => (/** @type {string} */ key) =>
    opening.loading ? undefined : fn(key);
  const keys = { ...always, ...Object.fromEntries(Object.entries(whenCalm).map(([id, fn]) => [id, calm(fn)])) };
  return { keys, canDraw, fitDrawn, placeAt };
}
