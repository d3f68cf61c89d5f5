// An owner's tokens: made, listed, revoked; and the last things that were done in his name.
import { $, ask, element, get, guard, send } from "./ask.js";

const LAST = 20; // deeds that are listed
const day = (time) => new Date(time).toLocaleDateString();

async function list() {
  const [{ tokens }, { actions }] = await Promise.all([get("/v1/tokens"), get(`/v1/audit?limit=${LAST}`)]);
  $("tokens").replaceChildren(...(tokens.length ? tokens.map(row) : [element("li", "none")]));
  $("audit").replaceChildren(...(actions.length ? actions.map((a) =>
    element("li", `${new Date(a.time).toLocaleString()}: ${a.action} ${a.target}, from ${a.client}`)) : [element("li", "nothing yet")]));
}

function row(token) {
  const ended = token.expires && new Date(token.expires) <= new Date();
  const told = [`made ${day(token.created)}`, token.expires ? `${ended ? "expired" : "good until"} ${day(token.expires)}` : "good for ever",
    token.used ? `last used ${day(token.used)}` : "not used yet"];
  const item = element("li", `${token.label || token.id}: ${told.join(", ")} `);
  const button = element("button", "Revoke", { type: "button", ariaLabel: `Revoke ${token.label || token.id}` });
  button.onclick = guard(async () => {
    if (!confirm(`Revoke ${token.label || token.id}? Whatever uses it is refused from then on.`)) return;
    await ask("/v1/tokens/" + token.id, { method: "DELETE" });
    await list();
  });
  item.append(button);
  return item;
}

const make = guard(async () => {
  const days = $("token-days").value;
  const made = await send("POST", "/v1/tokens", { label: $("token-label").value, ...(days ? { days: Number(days) } : {}) });
  $("made-token").replaceChildren("Told this once: ", element("code", made.token));
  $("token-label").value = $("token-days").value = "";
  await list();
});

export function accountControls() {
  $("new-token").onsubmit = make;
  $("account").ontoggle = guard(async () => {
    if ($("account").open) await list();
    else $("made-token").replaceChildren();
  });
}
