/** Background jobs of the server: start, follow, stop. Several modes show them. */

import { button, count, h, patch } from "./dom.js";
import { errorBox, showProblem } from "./forms.js";

/** What a kind of job is called in a sentence. @type {Record<Api.Job["kind"], string>} */
export const NAMES = {
  train: "training",
  propose: "proposals",
  lift: "proposals",
  boxes: "import of boxes",
  export: "export",
  import: "import of boxes",
  copy: "copy of a project",
  sample: "sample project",
};

/** Those that the start page shows. @type {Api.Job["kind"][]} */
export const OF_START = ["import", "boxes", "copy", "sample"];

export const isActive = (/** @type {Api.Job | null | undefined} */ job) =>
  job?.state === "queued" || job?.state === "running";

/** The jobs of some kinds in a project, the newest first. */
export const jobsOf = (
  /** @type {App} */ app,
  /** @type {string | null} */ project,
  /** @type {Api.Job["kind"][]} */ ...kinds
) =>
  app.state.jobs
    .filter((job) => kinds.includes(job.kind) && job.project === project)
    .toSorted((a, b) => b.created_ns - a.created_ns);

/** The newest job of a kind in the open project. */
export const latestJob = (/** @type {App} */ app, /** @type {Api.Job["kind"]} */ kind) =>
  jobsOf(app, app.state.route.project, kind).at(0);

/** Starts a job and shows it at once. */
export async function startJob(
  /** @type {App} */ app,
  /** @type {Api.TrainRequest | Api.ProposeRequest | Api.LiftRequest | Api.ExportRequest} */ request,
) {
  takeJob(app, await app.api.post(app.path("jobs"), request));
}

/**
 * A form that starts a job; what is wrong is said at its end.
 *
 * @param {App} app
 * @param {object} options
 * @param {string} options.name in its test ids.
 * @param {string} options.label of the button that starts the job.
 * @param {(start: HTMLButtonElement) => Child[]} options.content
 * @param {() => Parameters<typeof startJob>[1]} options.request throws what is wrong with what was chosen.
 * @param {() => unknown} options.show called afterwards, says whether the button is disabled.
 */
export function createJobForm(app, { name, label, content, request, show }) {
  const start = h("button.primary", { type: "submit", "data-testid": `${name}-start` }, label);
  const problem = errorBox();
  const form = h("form.stack", { "data-testid": `${name}-form`, onsubmit: submit }, content(start), problem);

  async function submit(/** @type {SubmitEvent} */ event) {
    event.preventDefault();
    showProblem(problem, null);
    start.disabled = true;
    try {
      await startJob(app, request());
    } catch (error) {
      showProblem(problem, error);
    }
    show();
  }

  return { form, start };
}

/** Shows a job that was started; what an event has said of it before is newer. */
export function takeJob(/** @type {App} */ app, /** @type {Api.Job} */ job) {
  const { jobs } = app.state;
  app.state.set({ jobs: jobs.some(({ id }) => id === job.id) ? jobs : [job, ...jobs] });
}

/** Reads all jobs. What is heard of a job meanwhile is newer. */
export async function readJobs(/** @type {App} */ app) {
  const before = app.state.jobs;
  const jobs = await app.api.get("/api/jobs");
  const heard = app.state.jobs.filter((job) => !before.includes(job));
  app.state.set({ jobs: [...heard, ...jobs.filter(({ id }) => !heard.some((job) => job.id === id))] });
}

/** 75 -> "1 min 15 s". */
function duration(/** @type {number} */ seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  const minutes = Math.floor(whole / 60);
  if (minutes < 60) return `${minutes} min ${whole % 60} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/**
 * A line with the state of a job (by default the newest of its kind), its progress, and a button to stop it. It follows the
 * job as long as it is in the page, where it must be put at once.
 *
 * @param {App} app
 * @param {Api.Job["kind"]} kind
 * @param {() => Api.Job | null | undefined} [find]
 */
export function createJobLine(app, kind, find = () => latestJob(app, kind)) {
  /** The job that imports what the one of this line has left out. */
  let rest = "";
  const current = () => app.state.jobs.find(({ id }) => id === rest) ?? find();
  const root = h("div.job-line", { "data-testid": `job-${kind}`, role: "status" });

  async function importRest(/** @type {Api.Job} */ job) {
    const { importLeftOut } = await import("./start/boxes_file.js");
    const begun = await importLeftOut(app, job);
    if (!begun) return;
    rest = begun.id;
    takeJob(app, begun);
  }

  function show() {
    const job = current();
    root.hidden = !job;
    if (!job) return;
    root.dataset.state = job.state;
    // boxes of classes that the project does not have are no success
    const { unknown = {}, recordings } = /** @type {ImportResult} */ (job.result ?? {});
    const classes = Object.keys(unknown);
    const hasLeftOut = classes.length > 0;
    const leftOut = `Left out: the boxes of ${classes.join(", ")}, which the project does not have as classes. `;
    const look = job.state === "failed" ? "bad" : hasLeftOut ? "warn" : "";
    const bar = h("progress", { max: 1, "aria-label": "Progress" });
    showProgress(bar, job);
    const stop = () => app.api.post(`/api/jobs/${job.id}/cancel`);
    patch(
      root,
      h("span", { class: `grow ${look}`, "data-testid": `job-${kind}-text` }, [
        hasLeftOut && recordings && leftOut,
        describe(job, app.state.jobs),
      ]),
      isActive(job) && bar,
      job.state === "running" && job.eta_s !== null && h("span.muted.number", `about ${duration(job.eta_s)} left`),
      hasLeftOut &&
        recordings &&
        button("Choose classes …", () => importRest(job), { "data-key": "rest", "data-testid": "choose-classes" }),
      isActive(job) && button("Stop", stop, { class: "danger", "data-key": "stop", "data-testid": `stop-${kind}` }),
    );
  }

  /** @type {() => unknown} */
  const forget = app.state.on("jobs", () => (root.isConnected ? show() : forget()));
  show();
  return root;
}

/** Shows how far a job is, as far as that is known. */
export function showProgress(/** @type {HTMLProgressElement} */ bar, /** @type {Api.Job} */ { done, total }) {
  if (total > 0) bar.value = done / total;
  else bar.removeAttribute("value");
}

/** What a job that waits its turn waits for, and how long that takes as far as it is known. */
export function waiting(/** @type {Api.Job} */ job, /** @type {Api.Job[]} */ jobs) {
  const turn = (/** @type {Api.Job} */ { background, created_ns }) => Number(background) * 2 ** 63 + created_ns;
  const lane = jobs.filter((other) => other.heavy === job.heavy && other.id !== job.id);
  const running = lane.find(({ state }) => state === "running");
  const before = lane.filter((other) => other.state === "queued" && turn(other) < turn(job)).length;
  if (!running) return before ? `Waits for ${count(before, "job")}` : "About to begin";
  const whose = running.project === job.project ? "" : ` in ${running.project}`;
  const left = running.eta_s === null ? "" : `, about ${duration(running.eta_s)} left`;
  return `Waits for the ${NAMES[running.kind]}${whose}${left}${before ? `, then for ${count(before, "more job")}` : ""}`;
}

function describe(/** @type {Api.Job} */ job, /** @type {Api.Job[]} */ jobs) {
  if (job.state === "queued") return waiting(job, jobs);
  if (job.state === "running") return job.stage || "Running";
  if (job.state === "failed") return `Failed: ${job.message ?? "see the server's log"}`;
  if (job.state === "cancelled") return job.message ?? "Stopped";
  return job.message ?? "Done";
}
