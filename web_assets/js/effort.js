/**
 * The effort that goes into labels, counted as SAnE counts it: actions, and seconds in which the operator was at work.
 *
 * An action is one finished drag, one key or one click that changes something; looking around is none. Time runs from one
 * sign of life (pointer, wheel, key) to the next, and a pause of any length counts as at most 30 s. What the server has
 * acknowledged is taken off, so nothing is counted twice and nothing is lost with a refused request.
 */

const LONGEST_PAUSE_S = 30;
const SIGNS = ["pointerdown", "pointermove", "wheel", "keydown"];

export function createEffort(now = () => performance.now() / 1000) {
  let actions = 0;
  let seconds = 0;
  let last_s = now();

  function alive() {
    const time = now();
    seconds += Math.min(time - last_s, LONGEST_PAUSE_S);
    last_s = time;
  }

  return {
    /** One more action, or several. */
    action(n = 1) {
      alive();
      actions += n;
    },

    /** Time runs on: something was done, though it changes nothing. */
    alive,

    /** Watches a window or document for signs of life. */
    watch(target) {
      for (const name of SIGNS) target.addEventListener(name, alive, { capture: true, passive: true });
    },

    /** What there is now, to be sent along with a change. */
    peek() {
      alive();
      return { actions, seconds: Math.round(seconds * 1000) / 1000 };
    },

    /** Takes off what the server has acknowledged. */
    acknowledge(sent) {
      actions = Math.max(0, actions - sent.actions);
      seconds = Math.max(0, seconds - sent.seconds);
    },

    /** Gives up what was counted: another frame was opened, and its objects did not cost this. */
    reset() {
      actions = 0;
      seconds = 0;
      last_s = now();
    },
  };
}
