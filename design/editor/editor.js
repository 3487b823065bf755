// What is done to the pad goes to the program, one thing at a time; its answer is the whole of what is shown.
const STEP_MM = .5, FINE_MM = .05
const chosen = {fibre: 0, knot: 1}
const waiting = [] // edits not sent yet
let view = null, busy = false, held = null, gestures = 0, refused = ""

const knotCount = fibre => view.fibres[fibre].knots.length - 2
const heldKnot = () => layers.knots[chosen.fibre]?.[chosen.knot - 1]

function choose(fibre, knot = chosen.knot) {
  chosen.fibre = fibre
  chosen.knot = Math.max(1, Math.min(knot, knotCount(fibre)))
  draw()
}

// Of moves of one gesture only the last counts.
function ask(edit) {
  const last = waiting.at(-1)
  if (last && edit.do === "move" && last.do === "move" && last.gesture === edit.gesture) waiting.pop()
  waiting.push(edit)
  send()
}

async function post(address, what) {
  try {
    const answer = await fetch(address, {method: "POST", body: JSON.stringify(what)})
    refused = answer.ok ? "" : await answer.text()
    if (answer.ok) return await answer.json()
  } catch {
    refused = "the program does not answer: is it still running?"
  }
  tell()
  return null
}

async function send() {
  if (busy) return
  busy = true
  while (waiting.length) {
    const edit = waiting.shift(), fibre = chosen.fibre, answer = await post("/edit", edit)
    if (!answer) continue
    const changed = edit.do === "add" || edit.do === "remove"
    if (changed && chosen.fibre === fibre) [chosen.fibre, chosen.knot] = answer.at // else another was chosen meanwhile
    show(answer)
    if (changed) heldKnot()?.focus()
  }
  busy = false
}

async function save() {
  const answer = await post("/save", {})
  if (answer) show(answer)
}

function moveTo(place, gesture) {
  if (knotCount(chosen.fibre) < 1) return
  ask({do: "move", fibre: chosen.fibre + 1, knot: chosen.knot, gesture, ...place})
}

// What is held keeps its distance to the pointer: a finger covers more than a knot.
function hold(fibre, knot, event) {
  choose(fibre, knot)
  const at = pointed(view, event), [px, py] = view.fibres[fibre].knots[knot]
  const gesture = `${Math.random().toString(36).slice(2, 10)} ${++gestures}`
  held = {gesture, right: px - at.x_mm, up: py - at.y_mm, moved: false}
  byId("pad").setPointerCapture(event.pointerId)
  heldKnot().focus({focusVisible: false})
  event.preventDefault()
}
function drag(event) {
  const at = pointed(view, event)
  moveTo({x_mm: at.x_mm + held.right, y_mm: at.y_mm + held.up}, held.gesture)
}
byId("pad").addEventListener("pointermove", event => {
  if (!held) return
  held.moved = true
  drag(event)
})
for (const kind of ["pointerup", "pointercancel"]) byId("pad").addEventListener(kind, event => {
  if (held?.moved && kind === "pointerup") drag(event)
  held = null
})

function add(fibre, event) {
  choose(fibre)
  ask({do: "add", fibre: fibre + 1, ...(event ? pointed(view, event) : {})})
}
function remove() { if (knotCount(chosen.fibre)) ask({do: "remove", fibre: chosen.fibre + 1, knot: chosen.knot}) }

const ARROWS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]}
let stepping = 0 // one gesture for as long as a key is down
addEventListener("keyup", event => { if (ARROWS[event.key]) stepping += 1 })
byId("pad").addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || !view?.ready) return
  if (ARROWS[event.key]) {
    const step = event.shiftKey ? FINE_MM : STEP_MM, [right, up] = ARROWS[event.key]
    const gesture = `key ${chosen.fibre} ${chosen.knot} ${stepping} ${performance.timeOrigin.toFixed(0)}`
    const last = waiting.at(-1), [px, py] = view.fibres[chosen.fibre].knots[chosen.knot]
    const from = last?.gesture === gesture ? last : {x_mm: px, y_mm: py}
    moveTo({x_mm: from.x_mm + right * step * (view.mirrored ? -1 : 1), y_mm: from.y_mm + up * step}, gesture)
  } else if (event.key === "PageDown" || event.key === "PageUp") {
    const count = view.fibres.length
    choose((chosen.fibre + (event.key === "PageDown" ? 1 : count - 1)) % count)
    heldKnot()?.focus()
  } else if (event.key === "Insert" || event.key === "+") add(chosen.fibre)
  else if (event.key === "Delete" || event.key === "Backspace" || event.key === "-") remove()
  else return
  event.preventDefault()
})
addEventListener("keydown", event => {
  if (!(event.ctrlKey || event.metaKey) || !view?.ready) return
  const key = event.key.toLowerCase()
  if (key === "z") ask({do: event.shiftKey ? "redo" : "undo"})
  else if (key === "y") ask({do: "redo"})
  else if (key === "s") save()
  else return
  event.preventDefault()
})

byId("undo").onclick = () => ask({do: "undo"})
byId("redo").onclick = () => ask({do: "redo"})
byId("save").onclick = save
byId("add").onclick = () => add(chosen.fibre)
byId("remove").onclick = remove
byId("lost").onchange = () => draw()
byId("fibre").onchange = () => choose(byId("fibre").selectedIndex)
addEventListener("beforeunload", event => { if (view?.unsaved && !view.ended) event.preventDefault() })

function tell() {
  byId("told").className = refused ? "refused" : ""
  const text = refused || (view.unsaved ? `not saved yet: Ctrl+S writes ${view.out}` : view.told || `nothing drawn yet; Ctrl+S writes ${view.out}`)
  if (byId("told").textContent !== text) byId("told").textContent = text
}

// Selections keep their options while they can, so that they keep their place.
function options(id, texts) {
  const list = byId(id)
  while (list.options.length > texts.length) list.remove(texts.length)
  texts.forEach((text, index) => {
    if (!list.options[index]) list.add(new Option(text))
    else if (list.options[index].text !== text) list.options[index].text = text
  })
}

function tellAnswer() {
  const broken = view.rules, families = ["horizontal", "vertical"]
  byId("rules").className = broken.length ? "" : "hold"
  byId("rules").replaceChildren(...(broken.length ? broken.map(rule => rule.text) : ["all rules hold"]).map(text => htmlElement("li", "", text)))
  byId("ambiguity").replaceChildren(...view.ambiguity.map((value, lost) => {
    const row = htmlElement("tr", "", ""), straight = view.straight[lost]
    row.append(htmlElement("th", "", lost), htmlElement("td", value < straight ? "better" : value > straight ? "worse" : "", value.toPrecision(3)), htmlElement("td", "", straight.toPrecision(3)))
    return row
  }))
  options("lost", view.ambiguity.map((_, lost) => `${lost}`))
  options("fibre", view.fibres.map((fibre, index) => {
    const count = broken.filter(rule => rule.fibres.includes(index + 1)).length, knots = fibre.knots.length - 2
    const depth = fibre.family === view.deep ? "deeper" : "higher"
    return `${index + 1}: ${families[fibre.family]}, ${depth}, ${knots} knot${knots === 1 ? "" : "s"}` + (count ? `, ${count} broken` : "")
  }))
  byId("save").disabled = byId("add").disabled = false
  byId("undo").disabled = !view.can_undo
  byId("redo").disabled = !view.can_redo
}

function draw() {
  if (!view?.ready) return
  if (layerKey(view) !== layers.key) {
    const focused = byId("knots").contains(document.activeElement)
    build(view, {choose, hold, add})
    if (focused) heldKnot()?.focus()
  }
  const lost = Math.max(0, byId("lost").selectedIndex), limit = 3 * view.straight[lost]
  byId("most").textContent = limit.toPrecision(2)
  byId("fibre").selectedIndex = chosen.fibre
  byId("remove").disabled = knotCount(chosen.fibre) < 1
  update(view, chosen, limit, lost)
}

function show(next) {
  byId("title").textContent = next.title
  const link = byId("link")
  link.className = next.ended ? "disconnected" : ""
  link.textContent = next.ended || (next.ready ? "ready" : "getting ready: this takes a minute the first time")
  if (view && next.ended) view.ended = next.ended
  const begins = view?.session !== next.session
  if (next.ready && (begins || next.number > view.number)) {
    view = next
    if (begins) [chosen.fibre, chosen.knot] = [0, 1]
    chosen.fibre = Math.min(chosen.fibre, view.fibres.length - 1)
    chosen.knot = Math.max(1, Math.min(chosen.knot, knotCount(chosen.fibre)))
    tellAnswer()
    draw()
    tell()
  }
}
for (const each of document.querySelectorAll("button")) each.disabled = true
subscribe(show)
