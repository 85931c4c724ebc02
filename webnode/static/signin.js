// Signing in and out: by the code that the node printed, which a link may carry, or by the password.
import { element, words } from "./element.js";
import { base, get, leave, signed } from "./link.js";
import { panel } from "./panel.js";
import { forget, keep, token } from "./session.js";

const PAUSE = 3000;
let checking = false;
let told = () => {};

// The code of a link is used once and taken out of the address, so that it is in no bookmark and no screenshot; what
// stands behind it is the view that the link leads to.
function codeOfLink() {
  const [, code, view] = /^#code=([^/]+)(?:\/(.+))?$/.exec(location.hash) ?? [];
  if (code) history.replaceState(null, "", location.pathname + location.search);
  if (view) location.hash = view;
  return code ? decodeURIComponent(code) : "";
}

const signIn = (code) => signed("POST", { code });

// Resolves when the visitor is let in, as often as it has to; `onMe` gets { name, role } each time.
export async function enter(onMe) {
  told = onMe;
  const code = codeOfLink();
  let trouble = "";
  if (code) await signIn(code).catch((error) => { trouble = error.message; });
  await check(trouble);
}

async function check(trouble = "") {
  checking = true;
  let me = await get("session").catch(() => null);
  while (!me || me.role === "anyone") {
    if (me) {
      if (token(base())) keep(base(), undefined);
      const { asked } = await import("./door.js");
      await asked(trouble, signIn);
    } else await new Promise((done) => setTimeout(done, 1000));
    trouble = "";
    me = await get("session").catch(() => null);
  }
  checking = false;
  told(me);
}

panel({
  place: "more",
  order: 90,
  title: "Session",
  needs: { role: "viewer" },
  make(root, { model }) {
    const who = element("p", { class: "hint" });
    const out = element("button", {}, "Sign out");
    const more = element("button", { class: "operators" }, "Invite …");
    const trouble = element("p", { role: "status" });
    out.onclick = async () => {
      await leave();
      forget();
      location.reload();
    };
    // What an invitation is made of is fetched when somebody invites.
    more.onclick = () => {
      words(trouble, "");
      import("./invite.js").then(({ open }) => open(model)).catch((error) => words(trouble, error.message));
    };
    let link = "wait";
    // A stream that ends may have ended because the session did.
    const timer = setInterval(() => { if (link === "lost" && !checking) check(); }, PAUSE);
    root.className = "session";
    root.append(who, element("div", { class: "row" }, more, out), trouble);
    return {
      update(model) {
        link = model.link;
        const { name, role } = model.me;
        words(who, `Signed in as ${name && name !== role ? `${name}, ${role}` : role}.`);
        out.hidden = !token(base());
      },
      close: () => clearInterval(timer),
    };
  },
});

panel({
  place: "more",
  order: 95,
  title: "Audit",
  needs: { role: "operator" },
  load: () => import("./audit.js"),
});
