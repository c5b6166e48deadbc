/**
 * The controls of the 3D view: a bar above it with what is shown and in which colours, and buttons in it that move the
 * viewer. `settings` is all that they change; it is sent with every scene.
 */

import { classColor, trackColor } from "./colors.js";
import { button, h } from "./dom.js";

/** @type {[Api.PointColor, string, string][]} */
const POINT_COLORS = [
  ["rgb", "Colour", "The camera's colours, or how bright the LiDAR's returns are"],
  ["depth", "Depth", "Distance from the camera"],
  ["height", "Height", "Height above the ground"],
  ["intensity", "Intensity", "How bright the points are"],
  ["unlabelled", "Nobody labelled", "Points that stand on the ground and are in no box"],
];
/** @type {[BoxColor, string][]} */
const BOX_COLORS = [
  ["state", "State"],
  ["class", "Class"],
  ["track", "Track"],
];
/** @type {[Api.Look, string, string][]} */
const LOOKS = [
  ["start", "Start", "Look from behind the camera"],
  ["camera", "Camera", "Look from the camera, as in the image"],
  ["top", "Top", "Look from above, at the selected box if there is one"],
  ["front", "Front", "Look at the front of the selected box, or ahead"],
  ["side", "Side", "Look at the left side of the selected box, or from the left"],
  ["behind", "Behind", "Look along the heading of the selected box"],
  ["focus", "Box", "Look at the selected box, and turn around it"],
];
/** Of the selected box only. */
const OF_BOX = new Set(["behind", "focus"]);
/** Upper ends of the shown heights, metres; the last position of the slider shows all. */
const HEIGHTS_M = [0.5, 1, 1.5, 2, 2.5, 3, 4, 5, 7, 10, 15];
const POINT_LIMITS = [0.1, 10];

/**
 * @param {object} on
 * @param {() => unknown} on.change the settings have changed.
 * @param {(look: Api.Look) => unknown} on.look
 */
export function createViewportBar(on) {
  const settings = {
    /** @type {Api.PointColor} */
    color: "rgb",
    point_size: 1,
    hide_ground: false,
    /** @type {number | null} */
    most_height: null,
    only_selected: false,
  };
  /** @type {BoxColor} */
  let boxColor = "state";
  /** @type {Api.PointColor} */
  let usualColor = "rgb";

  const points = choice(
    "Points",
    "∴",
    POINT_COLORS.map(([value, text]) => [value, text]),
    (value) => setColor(/** @type {Api.PointColor} */ (value)),
  );
  const boxes = choice("Boxes", "▢", BOX_COLORS, (value) => {
    boxColor = /** @type {BoxColor} */ (value);
    on.change();
  });
  const ground = toggle("Ground off", "Hide the ground (H)", "hide-ground", toggleGround);
  const only = toggle("Only this", "Show only the selected box and what is near it", "only-selected", () => {
    settings.only_selected = !settings.only_selected;
    changed();
  });
  const heightText = h("output.number", "all");
  /** @type {HTMLInputElement} */
  const height = h("input", {
    type: "range",
    min: "0",
    max: String(HEIGHTS_M.length),
    value: String(HEIGHTS_M.length),
    "aria-label": "Show points up to this height above the ground",
    title: "Show points up to this height above the ground",
    "data-testid": "most-height",
    oninput() {
      settings.most_height = HEIGHTS_M[Number(height.value)] ?? null;
      heightText.textContent = settings.most_height === null ? "all" : `≤ ${settings.most_height} m`;
      changed();
    },
  });
  const note = h("span.muted.number", { "data-testid": "viewport-points" });
  const looks = LOOKS.map(([look, text, title]) =>
    button(text, () => on.look(look), { title, "data-testid": `look-${look}` }),
  );
  const root = h(
    "div.viewport-bar",
    { role: "toolbar", "aria-label": "3D view" },
    points,
    boxes,
    ground,
    only,
    h("label.height", height, heightText),
    h("span.grow"),
    note,
  );

  function changed() {
    ground.setAttribute("aria-pressed", String(settings.hide_ground));
    only.setAttribute("aria-pressed", String(settings.only_selected));
    points.value = settings.color;
    points.title = `Colours of the points: ${POINT_COLORS.find(([value]) => value === settings.color)?.[2]}`;
    on.change();
  }

  function setColor(/** @type {Api.PointColor} */ color) {
    if (color !== "unlabelled") usualColor = color;
    settings.color = color;
    changed();
  }

  function toggleGround() {
    settings.hide_ground = !settings.hide_ground;
    changed();
  }

  function resize(/** @type {number} */ factor) {
    settings.point_size = Math.min(Math.max(settings.point_size * factor, POINT_LIMITS[0]), POINT_LIMITS[1]);
    changed();
  }

  return {
    root,
    /** The buttons that move the viewer, to be put over the view. */
    looks: h("div.viewport-looks", { role: "toolbar", "aria-label": "Views" }, looks),
    settings,

    /**
     * The colours of the boxes of a frame, by uid; those without one have the colour of their state.
     *
     * @param {Pick<Api.ProjectInfo, "classes" | "class_styles">} project
     * @param {Pick<PageLabel, "uid" | "label" | "track_id">[]} labels
     */
    boxColors: (project, labels) =>
      boxColor === "state"
        ? {}
        : Object.fromEntries(
            labels.map(({ uid, label, track_id }) => [
              uid,
              boxColor === "class" ? classColor(project, label) : trackColor(track_id),
            ]),
          ),

    /** Shows how many points are drawn, and what the selection allows. */
    show(/** @type {Api.SceneAnswer} */ { shown_points, points: all }, /** @type {boolean} */ hasSelection) {
      note.textContent = shown_points < all ? `${amount(shown_points)} of ${amount(all)}` : `${amount(all)} points`;
      note.title = `${shown_points.toLocaleString("en")} of ${all.toLocaleString("en")} points`;
      for (const [index, [look]] of LOOKS.entries()) looks[index].disabled = OF_BOX.has(look) && !hasSelection;
      only.disabled = !hasSelection && !settings.only_selected;
    },

    /** Lets what nobody labelled stand out, or no longer; returns whether that is a change. */
    showUnlabelled(/** @type {boolean} */ on) {
      const isChange = on !== (settings.color === "unlabelled");
      if (isChange) setColor(on ? "unlabelled" : usualColor);
      return isChange;
    },

    keys: {
      "look-box": () => on.look("focus"),
      "hide-ground": toggleGround,
      "points-larger": () => resize(1.25),
      "points-smaller": () => resize(0.8),
    },
  };
}

const amount = (/** @type {number} */ points) => points.toLocaleString("en", { notation: "compact" });

/**
 * @param {string} name
 * @param {string} sign
 * @param {[string, string][]} options
 * @param {(value: string) => void} choose
 */
function choice(name, sign, options, choose) {
  /** @type {HTMLSelectElement} */
  const select = h(
    "select",
    {
      "aria-label": `Colours of the ${name.toLowerCase()}`,
      title: `Colours of the ${name.toLowerCase()}`,
      "data-testid": `${name.toLowerCase()}-color`,
      onchange() {
        select.blur();
        choose(select.value);
      },
    },
    options.map(([value, text]) => h("option", { value }, `${sign} ${text}`)),
  );
  return select;
}

function toggle(
  /** @type {string} */ text,
  /** @type {string} */ title,
  /** @type {string} */ id,
  /** @type {() => void} */ onclick,
) {
  return button(text, onclick, { title, "aria-pressed": "false", "data-testid": id });
}
