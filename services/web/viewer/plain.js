// A file in archive form on a service: the service makes its plain form once, and keeps it beside the job's results.

const ARTIFACT = /^(\/v1\/jobs\/[^/]+\/artifacts)\/.+\.splatpress$/;
const PAUSE_S = 1;

/** What `Packed.open` says of a file in archive form. */
export class ArchiveForm extends Error {}

/** The address of the plain form of the artifact `content`, once it is made; null where `content` is none. `waiting` is called where it takes a while. */
export async function plainForm(content, headers, waiting) {
  const artifact = ARTIFACT.exec(content.pathname);
  if (!artifact) return null;
  for (;;) {
    const answer = await fetch(`${artifact[1]}?format=plain`, { headers, cache: "no-store" });
    const said = await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Error(said.detail || `the server answers ${answer.status} ${answer.statusText}`);
    if (said.artifacts.length) return new URL(said.artifacts[0].href, location.href);
    waiting();
    await new Promise((done) => setTimeout(done, 1000 * (Number(answer.headers.get("Retry-After")) || PAUSE_S)));
  }
}
