// Inviting: the page's address as a code for a phone's camera and as text, and what a phone wants before it gives the
// page its camera; fetched when somebody invites.
import { attribute, element, words } from "./element.js";
import { ask } from "./link.js";

const KINDS = { phone: "Take part with a phone", viewer: "Look at the team" };
const DRAWINGS = "image/svg+xml";

const STEPS = {
  "Android (Chrome)": [
    "Open the address of the certificate on the phone; ca.crt is downloaded.",
    "Settings, Security & privacy, More security settings, Encryption & credentials, Install a certificate, CA certificate, Install anyway.",
    "Choose ca.crt, then scan the first code.",
  ],
  "iPhone, iPad (Safari)": [
    "Open the address of the certificate in Safari, and allow the download.",
    "Settings, Profile Downloaded, Install.",
    "Settings, General, About, Certificate Trust Settings: switch on the node's name. Then scan the first code.",
  ],
};

// A code is shown when it looks as it should, and not before.
let styled;
function style() {
  styled ??= new Promise((done) => {
    const sheet = element("link", { rel: "stylesheet", href: "/static/invite.css" });
    sheet.onload = sheet.onerror = done;
    document.head.append(sheet);
  });
  return styled;
}

// A picture out of what the node has drawn; none where it has no library for that.
function draw(figure, svg, label) {
  figure.hidden = !svg;
  if (!svg) return;
  const drawing = document.importNode(new DOMParser().parseFromString(svg, DRAWINGS).documentElement, true);
  attribute(drawing, "role", "img");
  attribute(drawing, "aria-label", label);
  figure.replaceChildren(drawing);
}

// Text that is copied by one tap; over http, where a browser gives no page the clipboard, by the older way.
function copied(label, id, tell) {
  const text = element("input", { id, readonly: "" });
  const button = element("button", { type: "button" }, "Copy");
  button.onclick = async () => {
    text.select();
    const done = navigator.clipboard ? await navigator.clipboard.writeText(text.value).then(() => true, () => false) : document.execCommand("copy");
    tell(done ? "Copied." : "Select the text and copy it.");
  };
  return [text, element("div", {}, element("label", { for: id }, label), element("div", { class: "row" }, text, button))];
}

function steps() {
  return Object.entries(STEPS).map(([name, lines]) =>
    element("details", {}, element("summary", {}, name), element("ol", {}, ...lines.map((line) => element("li", {}, line)))));
}

function built() {
  const line = element("p", { role: "status" });
  const tell = (text) => words(line, text);
  const parts = {
    line, tell,
    kind: element("select", { id: "i-kind" }),
    page: element("select", { id: "i-page" }),
    code: element("figure", { class: "code" }),
    hint: element("p"),
    alone: element("p", { class: "warn" }),
    plain: element("p", { class: "warn" }),
    close: element("button", { type: "button" }, "Close"),
    authority: element("figure", { class: "code" }),
    mark: element("p", { class: "mark" }),
  };
  const [link, linkRow] = copied("Link", "i-link", tell);
  const [certificate, certificateRow] = copied("Certificate", "i-certificate", tell);
  const trust = element("section", { class: "trust" },
    element("h3", {}, "The phone warns of the connection"),
    element("p", {}, "That is right: the node vouches for itself, and the phone does not know it yet. For one visit accept the warning: ",
      element("b", {}, "Advanced, Proceed"), " (Chrome) or ", element("b", {}, "Show Details, visit this website"), " (Safari). ",
      "To come again, let the phone trust this node, once; to go on when it is lost, let it trust the other web nodes as well:"),
    ...steps(), parts.authority, certificateRow, parts.mark);
  const choices = element("div", { class: "choices" },
    element("div", {}, element("label", { for: "i-kind" }, "To"), parts.kind),
    element("div", {}, element("label", { for: "i-page" }, "By the address"), parts.page));
  const dialog = element("dialog", { id: "invite", "aria-labelledby": "h-invite" },
    element("div", { class: "bar" }, element("h2", { id: "h-invite" }, "Invite"), parts.close),
    choices, parts.alone, parts.plain, parts.code, linkRow, parts.hint, line, trust);
  return { ...parts, link, certificate, trust, dialog };
}

function options(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, name]) => element("option", { value }, name)));
  select.value = chosen;
}

function show(parts, told, role) {
  const isHere = told.reaches === "machine";
  parts.alone.hidden = !isHere;
  words(parts.alone, isHere ? "Only this machine can open the page, so no phone reaches it. Start the demonstration with make demo WEB_HOST=0.0.0.0, or a node with host = \"0.0.0.0\" below [web]." : "");
  draw(parts.code, isHere ? "" : told.code, "The link below as a code for the camera of a phone");
  parts.link.value = told.link;
  const until = new Date(1000 * told.until).toLocaleString([], { weekday: "long", hour: "2-digit", minute: "2-digit" });
  const may = role === "phone" ? "take part in the team with a phone" : "look, and give no orders";
  words(parts.hint, `${isHere ? "The link is for a browser of this machine." : "Scan the code, or send the link."} Whoever has it may ${may}, until ${until}.`);
  parts.plain.hidden = told.is_secure || role !== "phone";
  words(parts.plain, told.certificate
    ? "Over http no browser gives a page the camera: choose an address that begins with https."
    : "Over http no browser gives a page the camera, and this node has no https. Say pip install 'swarm-node[tls]', set tls = \"auto\" below [web], and start the node again.");
  parts.trust.hidden = !told.is_secure || isHere;
  draw(parts.authority, told.certificate_code, "The address of the certificate as a code for the camera of a phone");
  parts.certificate.value = told.certificate;
  words(parts.mark, `The phone shows the certificate's SHA-256 fingerprint; it has to be ${told.fingerprint}`);
}

export async function open(model) {
  await style();
  const parts = built();
  const kinds = Object.entries(KINDS).filter(([role]) => role !== "phone" || model.has.includes("phones"));
  options(parts.kind, kinds, kinds[0][0]);
  async function invite() {
    const role = parts.kind.value;
    parts.tell("");
    try {
      const told = await ask("POST", "invitations", { role, draw: true, page: parts.page.value });
      // A node that does not say where it is has at least been reached by this address.
      told.link ??= `${location.origin}/#code=${told.token}${role === "phone" ? "/phone" : ""}`;
      told.pages ??= [location.origin];
      if (!parts.page.options.length) options(parts.page, told.pages.map((url) => [url, url]), told.pages[0]);
      show(parts, told, role);
    } catch (error) {
      parts.tell(error.message);
    }
  }
  parts.kind.onchange = invite;
  parts.page.onchange = invite;
  parts.close.onclick = () => parts.dialog.close();
  parts.dialog.onclose = () => parts.dialog.remove();
  await invite();
  document.body.append(parts.dialog);
  parts.dialog.showModal();
}
