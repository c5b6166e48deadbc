/** Objects that another camera of the rig has: an outline with the camera's name, which cannot be selected. */

const COLOR = "#c3a6ff";

/**
 * @param {Api.OtherLabelJson[]} others
 * @returns {Overlay[]}
 */
export function otherOverlays(others) {
  return others.map(({ label, track_id, camera, outline }) => ({
    segments: outline,
    color: COLOR,
    dash: true,
    tag: `${label}${track_id === null ? "" : ` #${track_id}`} · ${camera}`,
  }));
}
