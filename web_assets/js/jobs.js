/** Background jobs of the server: start, follow, stop. Several modes show them. */

import { h } from "./dom.js";

/** @param {Api.Job} job */
export const isActive = (job) => job.state === "queued" || job.state === "running";

/**
 * The newest job of a kind in the open project, or null.
 *
 * @param {App} app
 * @param {Api.Job["kind"]} kind
 */
export function latestJob(app, kind) {
  const mine = app.state.jobs.filter((job) => job.kind === kind && job.project === app.state.route.project);
  return mine.toSorted((a, b) => b.created_ns - a.created_ns)[0] ?? null;
}

/**
 * Starts a job and shows it at once.
 *
 * @param {App} app
 * @param {Api.TrainRequest | Api.ProposeRequest | Api.LiftRequest | Api.ExportRequest} request
 */
export async function startJob(app, request) {
  /** @type {Api.Job} */
  const job = await app.api.post(app.path("jobs"), request);
  takeJob(app, job);
  return job;
}

/**
 * @param {App} app
 * @param {Api.Job} job
 */
export function takeJob(app, job) {
  app.state.set({ jobs: [job, ...app.state.jobs.filter(({ id }) => id !== job.id)] });
}

/**
 * 75 -> "1 min 15 s".
 *
 * @param {number} seconds
 */
function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  const minutes = Math.floor(whole / 60);
  if (minutes < 60) return `${minutes} min ${whole % 60} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/**
 * A line with the state of a job (by default the newest of its kind), its progress, and a button to stop it.
 *
 * @param {App} app
 * @param {Api.Job["kind"]} kind
 * @param {() => Api.Job | null | undefined} [find]
 */
export function createJobLine(app, kind, find = () => latestJob(app, kind)) {
  const text = h("span", { class: "grow", "data-testid": `job-${kind}-text` });
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const left = h("span", { class: "muted number" });
  const stop = h(
    "button",
    { type: "button", class: "danger", "data-testid": `stop-${kind}`, onclick: () => cancel() },
    "Stop",
  );
  const root = h("div", { class: "job-line", "data-testid": `job-${kind}`, role: "status" }, text, bar, left, stop);

  async function cancel() {
    const job = find();
    if (!job) return;
    stop.disabled = true;
    try {
      takeJob(app, await app.api.post(`/api/jobs/${job.id}/cancel`));
    } catch (error) {
      app.toast(error);
    } finally {
      stop.disabled = false;
    }
  }

  return {
    root,
    show() {
      const job = find();
      root.hidden = !job;
      if (!job) return;
      root.dataset.state = job.state;
      text.textContent = describe(job);
      text.className = `grow${job.state === "failed" ? " bad" : ""}`;
      stop.hidden = !isActive(job);
      bar.hidden = !isActive(job);
      if (job.total > 0) bar.value = job.done / job.total;
      else bar.removeAttribute("value");
      left.textContent = job.state === "running" && job.eta_s !== null ? `about ${duration(job.eta_s)} left` : "";
    },
  };
}

/** @param {Api.Job} job */
function describe(job) {
  if (job.state === "queued") return "Waiting for another job to end";
  if (job.state === "running") return job.stage || "Running";
  if (job.state === "failed") return `Failed: ${job.message ?? "see the server's log"}`;
  if (job.state === "cancelled") return job.message ?? "Stopped";
  return job.message ?? "Done";
}
