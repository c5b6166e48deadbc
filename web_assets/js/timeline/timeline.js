/**
 * The timeline at the bottom: small pictures of the frames, a slider, and a lane for each track of the recording. It
 * belongs to no mode: it shows `state.timeline`, `state.frame` and `state.track`, goes to frames by the address, and
 * tells in `state.span` which part of a track is selected. Lanes that are out of sight are not drawn.
 */

import { classColor, onTheme } from "../colors.js";
import { h, iconButton, patch } from "../dom.js";
import { makeHash } from "../router.js";
import {
  classOf,
  describe,
  lanesIn,
  moved,
  nameOf,
  pictures,
  placeAt,
  showing,
  spanAt,
  spansIn,
  whole,
  wordsOf,
  zoomed,
} from "./lanes.js";
import { createLoader } from "./loader.js";
import { placeNow } from "./reading.js";

const MODES = new Set(["annotate"]);
const FOLDED = "timeline-folded";
/** Width of the names, height of a lane, least width of a picture, half of the slider's knob, CSS pixels. */
export const NAMES = 128;
export const ROW = 15;
const PICTURE = 52;
const KNOB = 7;
/** How near to a box a click means it, and how far a drag has to go, CSS pixels. */
const REACH = 4;
const NO_TRACKS =
  "No tracks yet: an object that is followed through the recording (V), or given a track, has a lane here.";
/** The slider opens a frame after so long a rest. */
const REST_MS = 120;

export function mountTimeline(/** @type {HTMLElement} */ root, /** @type {App} */ app) {
  const { state } = app;
  let stretch = whole(1);
  let length = 0;
  /** @type {Lane[]} */
  let lanes = [];
  let isFolded = localStorage.getItem(FOLDED) === "yes";
  let width = 0;
  let willDraw = false;
  let timer = 0;
  /** Where the slider is being moved to. @type {number | null} */
  let sliding = null;
  /** @type {{ lane: Lane, from: number, x: number, isDrag: boolean } | null} */
  let press = null;
  let forgetKey = () => {};

  const note = h("output.number.muted", { "data-testid": "timeline-note" });
  const fold = h(
    "button",
    { type: "button", class: "quiet", "data-testid": "timeline-fold", onclick: () => setFolded(!isFolded) },
    "Timeline ",
    h("kbd", "L"),
  );
  const all = iconButton("fit", "Show the whole recording", () => setStretch(whole(total())), { disabled: true });
  const strip = h("div.strip", { "data-testid": "timeline-strip" });
  /** @type {HTMLInputElement} */
  const slider = h("input", {
    type: "range",
    min: 0,
    "aria-label": "Frame",
    "data-testid": "timeline-slider",
    oninput: slide,
    onchange: () => leaveSlider(),
    // so that the arrow keys are those of the mode again
    onpointerup: () => slider.blur(),
  });
  const canvas = h("canvas", { role: "img", "aria-label": "Tracks of this recording" });
  const none = h("p.muted");
  const space = h("div.space", none, canvas);
  const body = h("div.lanes", { "data-testid": "timeline-lanes", onscroll: () => drawSoon() }, space);
  root.replaceChildren(h("div.head", fold, all), strip, note, h("div.slide", slider), body);
  const loader = createLoader(drawSoon);

  const total = () => state.timeline?.frames.length ?? 0;
  const perPlace = () => (width - NAMES) / stretch.count;
  const xOf = (/** @type {number} */ place) => NAMES + (place - stretch.first) * perPlace();
  const placeOf = (/** @type {number} */ x) => stretch.first + (x - NAMES) / perPlace();

  // -- where to go

  function go(/** @type {number} */ place, /** @type {number | null} */ track = null) {
    const { project, mode } = state.route;
    const frame = state.timeline?.frames[place];
    if (frame !== undefined && project !== null)
      app.go(makeHash(project, mode, frame, { track: track === null ? null : String(track) }));
  }

  function slide() {
    sliding = Number(slider.value);
    clearTimeout(timer);
    timer = setTimeout(go, REST_MS, sliding);
    drawSoon();
  }

  function leaveSlider() {
    clearTimeout(timer);
    if (sliding !== null && sliding !== placeNow(state)) go(sliding);
    sliding = null;
  }

  function setStretch(/** @type {Stretch} */ value) {
    stretch = value;
    lanes = lanesIn(state.timeline?.lanes ?? [], stretch);
    space.style.height = `${lanes.length * ROW}px`;
    const hasTracks = state.timeline?.lanes.length !== 0;
    none.textContent = lanes.length > 0 || !state.timeline ? "" : hasTracks ? "No track is here." : NO_TRACKS;
    drawSoon();
  }

  function setFolded(/** @type {boolean} */ value) {
    isFolded = value;
    localStorage.setItem(FOLDED, value ? "yes" : "no");
    show();
  }

  // -- the pointer

  function laneAt(/** @type {PointerEvent} */ { offsetY }) {
    return lanes[Math.floor((offsetY + body.scrollTop) / ROW)] ?? null;
  }

  const pointed = (/** @type {PointerEvent} */ event, /** @type {Lane | null} */ lane) =>
    placeAt(lane, placeOf(event.offsetX), REACH / perPlace(), total());

  canvas.addEventListener("pointerdown", (event) => {
    const lane = laneAt(event);
    if (!lane || event.button !== 0 || event.offsetX < NAMES) return;
    press = { lane, from: pointed(event, null), x: event.offsetX, isDrag: false };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const lane = press?.lane ?? laneAt(event);
    const place = pointed(event, press ? null : lane);
    canvas.title = lane ? `${nameOf(lane)}, frame ${place + 1}: ${wordsOf(spanAt(lane, place))}` : "";
    if (!press) return;
    press.isDrag ||= Math.abs(event.offsetX - press.x) > REACH;
    const ids = state.timeline?.frames;
    const trackId = press.lane.track_id;
    if (!press.isDrag || !ids || trackId === null) return;
    state.set({ span: { trackId, from: ids[Math.min(press.from, place)], to: ids[Math.max(press.from, place)] } });
  });
  canvas.addEventListener("pointerup", (event) => {
    const lane = laneAt(event);
    const isClick = !press?.isDrag;
    press = null;
    if (!isClick || !lane) return;
    state.set({ span: null });
    // a click on a name goes to the track's nearest box
    const now = placeNow(state);
    const isName = event.offsetX < NAMES;
    const place = isName ? placeAt(lane, now + 0.5, Number.POSITIVE_INFINITY, total()) : pointed(event, lane);
    go(place, spanAt(lane, place) ? lane.track_id : null);
  });
  canvas.addEventListener("pointercancel", () => {
    press = null;
  });
  root.addEventListener(
    "wheel",
    (event) => {
      const isOverLanes = event.target instanceof Node && body.contains(event.target);
      const x = event.clientX - root.getBoundingClientRect().left;
      // some browsers turn it themselves
      const aside = event.deltaX || (event.shiftKey ? event.deltaY : 0);
      if (event.ctrlKey || (!isOverLanes && !event.shiftKey && event.deltaY !== 0)) {
        setStretch(zoomed(stretch, 1.25 ** -Math.sign(event.deltaY), placeOf(Math.max(x, NAMES)), total()));
      } else if (aside !== 0) setStretch(moved(stretch, aside / perPlace(), total()));
      else return;
      event.preventDefault();
    },
    { passive: false },
  );

  // -- drawing

  function drawSoon() {
    if (willDraw) return;
    willDraw = true;
    requestAnimationFrame(() => {
      willDraw = false;
      draw();
    });
  }

  function draw() {
    width = root.clientWidth;
    if (root.hidden || width === 0) return;
    const now = placeNow(state);
    const place = sliding ?? now;
    note.textContent = place < 0 ? "" : `${place + 1} / ${total()}`;
    const [low, high] = [Math.ceil(stretch.first), Math.floor(stretch.first + stretch.count) - 1];
    Object.assign(slider, { min: String(low), max: String(high), disabled: total() < 2 });
    if (sliding === null && now >= 0) slider.value = String(now);
    slider.classList.toggle("away", place < low || place > high);
    slider.style.marginLeft = `${xOf(low + 0.5) - NAMES - KNOB}px`;
    slider.style.width = `${(high - low) * perPlace() + 2 * KNOB}px`;
    all.disabled = stretch.count >= total();
    if (isFolded) return;
    drawStrip(place);
    drawLanes(place);
  }

  function drawStrip(/** @type {number} */ now) {
    const { timeline } = state;
    const shown = timeline ? pictures(stretch, total(), Math.floor((width - NAMES) / PICTURE)) : [];
    loader.want(shown.map(({ place }) => timeline?.picture(timeline.frames[place]) ?? ""));
    patch(
      strip,
      shown.map(({ place, first, last }) => {
        const url = timeline?.picture(timeline.frames[place]) ?? "";
        const cell = h("button", {
          type: "button",
          tabindex: -1,
          "data-key": String(place),
          "aria-label": `Frame ${place + 1}`,
          "aria-current": now >= place && now < last ? "true" : null,
          onclick: () => go(place),
        });
        // not an image, which would be loaded again for each drawing
        if (loader.has(url)) cell.style.backgroundImage = `url("${url}")`;
        cell.style.width = `${(last - first) * perPlace()}px`;
        return cell;
      }),
    );
  }

  function drawLanes(/** @type {number} */ now) {
    const height = body.clientHeight;
    const ratio = globalThis.devicePixelRatio;
    const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== wide || canvas.height !== high) {
      Object.assign(canvas, { width: wide, height: high });
      Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
    }
    const { timeline, track, span } = state;
    const part = span && timeline ? partOf(span, timeline) : null;
    canvas.setAttribute("aria-label", describe(timeline?.lanes ?? [], span?.trackId ?? track, part));
    const context = canvas.getContext("2d");
    if (!context) return;
    // the page's colours, which `light-dark` hides from a canvas
    const {
      color: text,
      borderTopColor: line,
      outlineColor: accent,
      caretColor: muted,
      font,
    } = getComputedStyle(canvas);
    Object.assign(context, { font, textBaseline: "middle" });
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const top = body.scrollTop;
    const from = Math.floor(top / ROW);
    lanes.slice(from, Math.ceil((top + height) / ROW)).forEach((lane, i) => {
      drawLane(context, lane, (from + i) * ROW - top, { text, line, accent, muted });
    });
    if (now < 0 || !lanes.length) return;
    context.fillStyle = accent;
    context.fillRect(Math.round(xOf(now + 0.5)), 0, 1, height);
  }

  function drawLane(
    /** @type {CanvasRenderingContext2D} */ context,
    /** @type {Lane} */ lane,
    /** @type {number} */ y,
    /** @type {Record<"text" | "line" | "accent" | "muted", string>} */ colors,
  ) {
    const { project, span, track, timeline } = state;
    const colorOf = (/** @type {string | null} */ name) =>
      project && name !== null ? classColor(project, name) : colors.muted;
    const isSelected = track !== null && track === lane.track_id;
    const middle = y + ROW / 2;
    context.save();
    if (isSelected) {
      context.fillStyle = colors.line;
      context.fillRect(0, y, width, ROW);
    }
    context.fillStyle = colorOf(classOf(lane));
    context.fillRect(8, middle - 4, 8, 8);
    context.fillStyle = isSelected ? colors.text : colors.muted;
    context.fillText(nameOf(lane), 22, middle, NAMES - 28);
    context.beginPath();
    context.rect(NAMES, 0, width - NAMES, body.clientHeight);
    context.clip();
    // from its first to its last box; gaps show this line
    context.fillStyle = isSelected ? colors.muted : colors.line;
    const [begin, end] = [xOf(lane.spans[0][0]), xOf(lane.spans[lane.spans.length - 1][1] + 1)];
    // one that stands still is one bar, paler where no frame sees it
    const height = lane.still ? ROW - 5 : 1;
    if (lane.still) Object.assign(context, { fillStyle: colorOf(classOf(lane)), globalAlpha: 0.35 });
    context.fillRect(begin, middle - height / 2, end - begin, height);
    const least = perPlace() > 3 && !lane.still ? 1 : 0;
    for (const [first, last, name, level] of spansIn(lane, stretch)) {
      // reviewed boxes are tall and full, proposals low and the paler the more doubtful they are
      context.globalAlpha = level === 0 ? 1 : 1.05 - 0.16 * level;
      context.fillStyle = colorOf(name);
      const tall = level === 0 ? ROW - 5 : ROW - 10;
      context.fillRect(xOf(first), middle - tall / 2, Math.max((last + 1 - first) * perPlace() - least, 1), tall);
    }
    context.globalAlpha = 1;
    if (span && span.trackId === lane.track_id && timeline) {
      const [one, two] = partOf(span, timeline);
      context.strokeStyle = colors.accent;
      context.lineWidth = 2;
      context.strokeRect(xOf(one), y + 1, (two + 1 - one) * perPlace(), ROW - 2);
    }
    context.restore();
  }

  // -- showing

  function show() {
    const { route, project } = state;
    root.hidden = !MODES.has(route.mode) || !project?.frames;
    root.classList.toggle("folded", isFolded);
    fold.setAttribute("aria-expanded", String(!isFolded));
    const now = placeNow(state);
    if (now >= 0) stretch = showing(stretch, now, total());
    setStretch(stretch);
  }

  /** Scrolls to the lane of the selected track. */
  function showTrack() {
    const at = lanes.findIndex(({ track_id }) => track_id !== null && track_id === state.track);
    if (at >= 0 && (at * ROW < body.scrollTop || (at + 1) * ROW > body.scrollTop + body.clientHeight))
      body.scrollTop = (at + 0.5) * ROW - body.clientHeight / 2;
    drawSoon();
  }

  state.on("timeline", () => {
    // the cameras of a rig have the same frames: what is zoomed stays so
    if (total() !== length) stretch = whole(total());
    length = total();
    show();
    showTrack();
  });
  for (const name of /** @type {const} */ (["frame", "route", "project"])) state.on(name, show);
  for (const name of /** @type {const} */ (["route", "frame"])) state.on(name, () => loader.rest());
  state.on("track", showTrack);
  state.on("span", (span) => {
    forgetKey();
    forgetKey = span ? app.keys.register({ cancel: () => state.set({ span: null }) }) : () => {};
    drawSoon();
  });
  app.keys.register({ timeline: () => setFolded(!isFolded) });
  new ResizeObserver(drawSoon).observe(root);
  onTheme(drawSoon);
  show();
}

/** The first and last place of a selected part of a track. @returns {[number, number]} */
const partOf = (/** @type {NonNullable<StateValues["span"]>} */ { from, to }, /** @type {Timeline} */ { places }) => [
  places.get(from) ?? 0,
  places.get(to) ?? 0,
];
