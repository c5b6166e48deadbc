/** The image with the cloud over it, coloured by depth, and the level. The wheel zooms, a drag moves the picture. */

import { line, project } from "../camera.js";
import { h } from "../dom.js";
import { createView } from "../editor2d/geometry.js";
import { checkbox } from "../forms.js";
import { add, dot } from "../rotation.js";
import { horizon, levelLines, quantile } from "./level.js";
import { rotationOf } from "./setting.js";

/** @typedef {{ image: string, camera: Camera, points: Vector[], up: Vector, isFirm: boolean }} Shown */

/** The panel of the picture. `onMissing`: its image could not be loaded. */
export function createPicture(/** @type {{ onMissing: (url: string) => unknown }} */ { onMissing }) {
  const canvas = h("canvas", { "data-testid": "alignment-picture", "aria-label": "The cloud over the image" });
  const host = h("div.picture", canvas);
  const image = new Image();
  /** @type {Shown | null} */
  let shown = null;
  let pending = 0;
  const size = { width: 0, height: 0 };
  const picture = { width: 0, height: 0 };
  const view = createView(picture, size);
  const points = checkbox("show-points", true, { onchange: draw });
  const level = checkbox("show-level", true, { onchange: draw });
  const thickness = h("input", { type: "range", min: 1, max: 8, step: 0.5, value: "2", oninput: draw });

  /** Draws once per animation frame. */
  function draw() {
    if (pending === 0) pending = requestAnimationFrame(paint);
  }

  function paint() {
    pending = 0;
    const context = canvas.getContext("2d");
    if (context === null || size.width === 0) return;
    const ratio = devicePixelRatio || 1;
    canvas.width = size.width * ratio;
    canvas.height = size.height * ratio;
    context.scale(ratio, ratio);
    if (shown === null) return;
    const { camera } = shown;
    const [left, top] = view.toWindow([0, 0]);
    context.translate(left, top);
    context.scale(view.scale, view.scale);
    if (image.complete && image.naturalWidth > 0) {
      context.imageSmoothingEnabled = view.scale < 3;
      context.drawImage(image, -0.5, -0.5, camera.width, camera.height);
    }
    context.beginPath();
    context.rect(-0.5, -0.5, camera.width, camera.height);
    context.clip();
    if (points.checked) paintPoints(context, shown, Number(thickness.value) / view.scale);
    if (level.checked) paintLevel(context, shown, 1.5 / view.scale);
  }

  function onWheel(/** @type {WheelEvent} */ event) {
    event.preventDefault();
    view.zoomAbout([event.offsetX, event.offsetY], Math.exp(-event.deltaY / 400));
    draw();
  }

  function onMove(/** @type {PointerEvent} */ event) {
    if (event.buttons === 0) return;
    view.panBy(event.movementX, event.movementY);
    draw();
  }

  function resize() {
    size.width = host.clientWidth;
    size.height = host.clientHeight;
    if (view.isFitted) view.fit();
    draw();
  }

  canvas.addEventListener("wheel", onWheel, { passive: false });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", onMove);
  image.addEventListener("load", draw);
  image.addEventListener("error", () => {
    draw();
    onMissing(image.src);
  });
  const resizing = new ResizeObserver(resize);
  resizing.observe(host);

  const header = h("header", [
    h("h1.ellipsis", "Cloud over image"),
    h("span.grow"),
    h("label.row", points, "points"),
    h("label.row", { title: "Size of the points" }, thickness),
    h("label.row", level, "level"),
  ]);
  const help = "Near points are red, far ones blue. The wheel zooms; drag to move the picture.";
  return {
    root: h("section.panel", header, host, h("footer.help", help)),
    host,
    set(/** @type {Shown} */ next) {
      shown = next;
      const { width, height } = next.camera;
      if (width !== picture.width || height !== picture.height) {
        Object.assign(picture, { width, height });
        view.fit();
      }
      if (!image.src.endsWith(next.image)) image.src = next.image;
      draw();
    },
    close() {
      resizing.disconnect();
      cancelAnimationFrame(pending);
    },
  };
}

/** The points after a correction. */
export function moved(/** @type {Vector[]} */ points, /** @type {Api.CorrectionJson} */ { turn_deg, shift_m }) {
  const turn = rotationOf(turn_deg);
  return points.map((point) =>
    add(
      turn.map((row) => dot(row, point)),
      shift_m,
    ),
  );
}

function paintPoints(
  /** @type {CanvasRenderingContext2D} */ context,
  /** @type {Shown} */ { camera, points },
  /** @type {number} */ size,
) {
  const depths = points.map((point) => point[2]).filter((z) => z > 0);
  if (depths.length === 0) return;
  const near = quantile(depths, 0.02);
  const far = Math.max(near * 1.01, quantile(depths, 0.98));
  for (const point of points) {
    const px = project(camera, point);
    if (px === null) continue;
    // equal steps of 1 / depth, as the effect of a shift on the image
    const share = Math.min(1, Math.max(0, (1 / point[2] - 1 / far) / (1 / near - 1 / far)));
    context.fillStyle = `hsl(${Math.round(250 * (1 - share))} 95% 55%)`;
    context.fillRect(px[0] - size / 2, px[1] - size / 2, size, size);
  }
}

function paintLevel(
  /** @type {CanvasRenderingContext2D} */ context,
  /** @type {Shown} */ { camera, points, up, isFirm },
  /** @type {number} */ width,
) {
  const { grid, plumb } = levelLines(up, points);
  context.setLineDash(isFirm ? [] : [6 * width, 4 * width]);
  for (const [lines, color, factor] of /** @type {[Vector[][], string, number][]} */ ([
    [grid, "rgb(0 0 0 / 60%)", 2.4],
    [grid, "#7fffb0", 1],
    [plumb, "#ffffff", 1.4],
    [horizon(up), "#ffd84a", 1.4],
  ])) {
    context.strokeStyle = color;
    context.lineWidth = width * factor;
    context.beginPath();
    for (const [from, to] of lines)
      for (const [first, ...others] of line(camera, from, to)) {
        context.moveTo(first[0], first[1]);
        for (const [x, y] of others) context.lineTo(x, y);
      }
    context.stroke();
  }
  context.setLineDash([]);
}
