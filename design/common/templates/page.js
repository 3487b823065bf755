"use strict"
// Paper cannot be clicked: what is folded is open on it.
let folded = []
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")]
  for (const each of folded) each.open = true
})
addEventListener("afterprint", () => { for (const each of folded) each.open = false })
