# LLVM writes a function's `.literal` lines before its `.section` line, so GNU as would put them
# into the section before. They are held back until the section is known: assembled with
# -mtext-section-literals they then lie beside the code that loads them, within l32r's reach.
/^\t\.literal_position$/ || /^\t\.literal / { held = held $0 "\n"; next }
/^\t\.section\t\.text/ || /^\t\.text$/ { print; next }
held != "" && /^\t\.p2align/ { printf "%s", held; held = ""; print; next }
{ print }
END { if (held != "") { print "literals without a section" > "/dev/stderr"; exit 1 } }
