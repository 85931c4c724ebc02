// Invitations: the page's address as QR code and text, and the steps with which a phone trusts the page's certificate.
// Loaded on demand.
import { setAttribute, createElement, setText } from "./element.js";
import { send } from "./connection.js";

const KINDS = { phone: "Join with a phone", viewer: "View the team" };
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

// Load the style sheet before the QR code is shown.
let styleLoaded;
function loadStyle() {
  styleLoaded ??= new Promise((done) => {
    const sheet = createElement("link", { rel: "stylesheet", href: "/static/invite.css" });
    sheet.onload = sheet.onerror = done;
    document.head.append(sheet);
  });
  return styleLoaded;
}

// Show the SVG drawn by the node; hidden if the node lacks the library for it.
function showQrCode(figure, svg, label) {
  figure.hidden = !svg;
  if (!svg) return;
  const drawing = document.importNode(new DOMParser().parseFromString(svg, DRAWINGS).documentElement, true);
  setAttribute(drawing, "role", "img");
  setAttribute(drawing, "aria-label", label);
  figure.replaceChildren(drawing);
}

// A text with a copy button; over http, where browsers offer no clipboard API, with execCommand.
function createCopyField(label, id, tell) {
  const text = createElement("input", { id, readonly: "" });
  const button = createElement("button", { type: "button" }, "Copy");
  button.onclick = async () => {
    text.select();
    const done = navigator.clipboard ? await navigator.clipboard.writeText(text.value).then(() => true, () => false) : document.execCommand("copy");
    tell(done ? "Copied." : "Select the text and copy it.");
  };
  return [text, createElement("div", {}, createElement("label", { for: id }, label), createElement("div", { class: "row" }, text, button))];
}

function createSteps() {
  return Object.entries(STEPS).map(([name, lines]) =>
    createElement("details", {}, createElement("summary", {}, name), createElement("ol", {}, ...lines.map((line) => createElement("li", {}, line)))));
}

function createDialog() {
  const line = createElement("p", { role: "status" });
  const tell = (text) => setText(line, text);
  const parts = {
    line, tell,
    kind: createElement("select", { id: "i-kind" }),
    page: createElement("select", { id: "i-page" }),
    code: createElement("figure", { class: "code" }),
    hint: createElement("p"),
    alone: createElement("p", { class: "warn" }),
    plain: createElement("p", { class: "warn" }),
    close: createElement("button", { type: "button" }, "Close"),
    authority: createElement("figure", { class: "code" }),
    mark: createElement("p", { class: "mark" }),
  };
  const [link, linkRow] = createCopyField("Link", "i-link", tell);
  const [certificate, certificateRow] = createCopyField("Certificate", "i-certificate", tell);
  const trust = createElement("section", { class: "trust" },
    createElement("h3", {}, "If the phone warns about the connection"),
    createElement("p", {}, "The warning is expected: the node signs its own certificate, which the phone does not know. For one visit accept the warning: ",
      createElement("b", {}, "Advanced, Proceed"), " (Chrome) or ", createElement("b", {}, "Show Details, visit this website"), " (Safari). ",
      "For further visits let the phone trust this node, once; to switch to other web nodes, let it trust those as well:"),
    ...createSteps(), parts.authority, certificateRow, parts.mark);
  const choices = createElement("div", { class: "choices" },
    createElement("div", {}, createElement("label", { for: "i-kind" }, "Purpose"), parts.kind),
    createElement("div", {}, createElement("label", { for: "i-page" }, "Address"), parts.page));
  const dialog = createElement("dialog", { id: "invite", "aria-labelledby": "h-invite" },
    createElement("div", { class: "bar" }, createElement("h2", { id: "h-invite" }, "Invite"), parts.close),
    choices, parts.alone, parts.plain, parts.code, linkRow, parts.hint, line, trust);
  return { ...parts, link, certificate, trust, dialog };
}

function setOptions(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, name]) => createElement("option", { value }, name)));
  select.value = chosen;
}

function show(parts, invitation, role) {
  const isHere = invitation.reaches === "machine";
  parts.alone.hidden = !isHere;
  setText(parts.alone, isHere ? "Only this machine can open the page. For phones start the demonstration with make demo WEB_HOST=0.0.0.0, or a node with host = \"0.0.0.0\" below [web]." : "");
  showQrCode(parts.code, isHere ? "" : invitation.code, "QR code of the link below");
  parts.link.value = invitation.link;
  const until = new Date(1000 * invitation.until).toLocaleString([], { weekday: "long", hour: "2-digit", minute: "2-digit" });
  const may = role === "phone" ? "to join the team with a phone" : "to view the team, without orders";
  setText(parts.hint, `${isHere ? "The link is for a browser of this machine." : "Scan the code, or send the link."} It allows its holder ${may}, until ${until}.`);
  parts.plain.hidden = invitation.is_secure || role !== "phone";
  setText(parts.plain, invitation.certificate
    ? "Browsers do not allow the camera over http. Choose an address that begins with https."
    : "Browsers do not allow the camera over http, and this node has no https. Run pip install 'swarm-node[tls]', set tls = \"auto\" below [web], and restart the node.");
  parts.trust.hidden = !invitation.is_secure || isHere;
  showQrCode(parts.authority, invitation.certificate_code, "QR code of the certificate's address");
  parts.certificate.value = invitation.certificate;
  setText(parts.mark, `Compare the SHA-256 fingerprint that the phone shows: ${invitation.fingerprint}`);
}

export async function openInvitation(model) {
  await loadStyle();
  const parts = createDialog();
  const kinds = Object.entries(KINDS).filter(([role]) => role !== "phone" || model.has.includes("phones"));
  setOptions(parts.kind, kinds, kinds[0][0]);
  async function invite() {
    const role = parts.kind.value;
    parts.tell("");
    try {
      const invitation = await send("POST", "invitations", { role, draw: true, page: parts.page.value });
      // A node that does not know its URLs was at least reached by this address.
      invitation.link ??= `${location.origin}/#code=${invitation.token}${role === "phone" ? "/phone" : ""}`;
      invitation.pages ??= [location.origin];
      if (!parts.page.options.length) setOptions(parts.page, invitation.pages.map((url) => [url, url]), invitation.pages[0]);
      show(parts, invitation, role);
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
